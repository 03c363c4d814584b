"""Bodies in sunlight: meshes, their places, their light and shadows."""
