"""What is true of a picture beside its light, computed apart from it: the nearest surface, depth, and optical flow."""
