"""Defines the command line, one thin file per command."""
