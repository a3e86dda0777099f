"""Checks whether signs, zeros and order of a robot's joints are as described."""
