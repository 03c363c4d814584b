"""Frames: the active pixels of a DAVIS, beside its event pixels, from the same light."""
