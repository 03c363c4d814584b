"""Stars, planets and debris: points of light on a dark sky."""
