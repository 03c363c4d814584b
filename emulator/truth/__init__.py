"""Ground truth beside the light of a frame, computed apart from it: the nearest surface, depth, and optical flow."""
