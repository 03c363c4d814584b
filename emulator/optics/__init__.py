"""From radiance in front of the lens to light on the pixels."""
