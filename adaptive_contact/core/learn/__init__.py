"""Learns, swing by swing: from labelled swings to what is known of free motion."""
