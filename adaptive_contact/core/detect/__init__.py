"""Detects contacts, tick by tick: samples to events, and to labelled swings for the learning."""
