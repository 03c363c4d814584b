"""Compiled loops, elementary functions in float32, and keyed random numbers."""
