"""The pixel step as a compute shader, for large sensors."""
