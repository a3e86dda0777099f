"""Robots, simulator models and learned baselines.  Data only; it imports nothing."""
