"""Definitions of the instrument's packets for ground systems, generated from the types that the code uses."""
