"""Attitudes, the pinhole camera, and the phase of periodic motion."""
