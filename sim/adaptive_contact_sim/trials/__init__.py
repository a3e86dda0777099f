"""Scenarios of change: recorded once, replayed through lesser and full learners, and judged.

:func:`scenarios` has them by name; :func:`run` makes what is missing of their recordings and
replays; :func:`table` turns these into figures, :mod:`pages` and :mod:`report` into pictures and
text.
"""
