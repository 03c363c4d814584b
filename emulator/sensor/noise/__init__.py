"""Temporal noise: hazards of first passages, the random points under them, and references at the start."""
