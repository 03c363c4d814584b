"""Pixels by other means than the product's: references, and rules to reproduce published results."""
