"""Real-time factor of whole runs beside their wrong events."""
