"""Legs of robots that nobody knows: a family to learn a prior from, and strangers to try it on."""
