"""The CPU renderer: exact mean light of each pixel and its exact time derivative in one pass."""
