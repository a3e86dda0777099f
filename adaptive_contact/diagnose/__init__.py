"""Diagnoses a leg's data, and what has become of the leg, for people; no event depends on it."""
