"""Access control and limits for the connections that evstim serves."""
