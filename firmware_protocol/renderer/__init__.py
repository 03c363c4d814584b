"""Messages of external renderers."""
