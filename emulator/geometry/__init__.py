"""Attitudes, the pinhole camera, what is seen through it beside light, and the phase of periodic motion."""
