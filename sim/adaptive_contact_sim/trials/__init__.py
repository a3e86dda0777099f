"""Scenarios of change: recorded once, replayed through lesser and full learners, and judged.

:mod:`~adaptive_contact_sim.trials.registry` has them by name,
:mod:`~adaptive_contact_sim.trials.runner` makes what is missing of their recordings and replays,
:mod:`~adaptive_contact_sim.trials.figures` and :mod:`~adaptive_contact_sim.trials.goals` turn
these into figures and verdicts, and pages of plots and ``docs/adaptation.md`` come from them.
"""
