"""Compares two revisions of the learner on the same recordings: ``make same REV=...``."""
