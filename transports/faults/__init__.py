"""Faults of links: their kinds, their schedule, their effects on the data, and an exact count of the data destroyed."""
