"""Commands of `evstim` that measure."""
