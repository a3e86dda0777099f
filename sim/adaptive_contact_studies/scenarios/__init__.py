"""Scenarios of change: recorded once, replayed through lesser and full learners, and judged.

``registry`` has them by name, ``runner`` makes what is missing of their recordings and replays,
``figures`` and ``goals`` turn these into figures and verdicts, and pages of plots and
``docs/adaptation.md`` come from them.
"""
