"""Judges and learns: a sample goes in, an event comes out, and the leg's model follows the leg.

``bank`` holds a robot's legs, ``leg_learner`` is one of them.  ``detect`` has the tick, ``learn``
what a swing teaches; neither imports the other.
"""
