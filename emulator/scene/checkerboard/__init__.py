"""A moving checkerboard in closed form."""
