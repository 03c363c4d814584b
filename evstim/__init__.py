"""What users import of evstim."""
