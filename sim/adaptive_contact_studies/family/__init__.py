"""Draws legs of random robots, learns the prior of any leg from them, and tries it on others."""
