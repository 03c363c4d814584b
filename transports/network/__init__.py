"""Who may connect to what evstim serves, and how many at once."""
