"""Checks whether a source can be believed: what is wrong with it, why, and what to do."""
