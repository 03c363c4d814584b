"""Lenses: from radiance in front of the lens to light on the pixels."""
