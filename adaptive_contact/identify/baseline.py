"""A learned baseline: one file, a model and its statistics per leg.

The file is JSON: a person can read the equations' coefficients, a diff shows what a relearning
changed, and there is nothing to execute in it.  It carries a format version, the robot's name and
the library's settings, and is refused in one line when any of them does not fit.
"""
