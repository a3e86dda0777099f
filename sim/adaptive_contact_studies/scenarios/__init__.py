"""Scenarios of change: recorded once, replayed through the learner and lesser ones, and judged.

``registry`` has them by name, ``replay`` makes recordings and what learners do with them, ``judge``
and ``results`` turn these into figures and verdicts, ``report`` into ``docs/adaptation.md``.
"""
