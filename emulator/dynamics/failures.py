"""What can go wrong with dynamics from outside."""

__all__ = ["DynamicsError", "FlightEnded"]


class DynamicsError(Exception):
    """The FMU, its mapping or its inputs cannot be used; the message says what to change."""


class FlightEnded(Exception):
    """The FMU failed during the flight; the message says when and how."""
