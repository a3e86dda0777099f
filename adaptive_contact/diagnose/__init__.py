"""What is wrong with a leg's data or has become of the leg, for people; no event depends on it."""
