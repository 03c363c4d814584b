"""Faults of links: what goes wrong on a serial line or a CAN bus, when, and exactly what it destroyed."""
