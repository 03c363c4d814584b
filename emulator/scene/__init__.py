"""Scenes: the worlds in front of the camera, which give the light at any time."""
