"""The photoreceptor as a circuit, for large and dim signals."""
