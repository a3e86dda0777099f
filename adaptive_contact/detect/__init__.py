"""The tick: from samples to contact events, and to labelled swings for the learning."""
