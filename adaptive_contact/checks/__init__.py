"""Checks what a source sends: one file per fault."""
