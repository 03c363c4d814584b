"""Attitudes, the pinhole camera, the geometry of its light frames, and the phase of periodic motion."""
