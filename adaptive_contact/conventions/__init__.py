"""Are a robot's angles counted as it is described: signs, zeros, order of joints."""
