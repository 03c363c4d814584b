"""Device: the interface that every emulated camera has, its items, their fates and its clock."""

LEAST_FACTOR, MOST_FACTOR = 0.1, 1000.0
"""Bounds of each of `HostAdjusted.sensor_factors`: a host's biases move a parameter no further."""
