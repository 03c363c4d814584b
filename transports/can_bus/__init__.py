"""CAN buses: real ones by python-can, and one that evstim makes itself."""
