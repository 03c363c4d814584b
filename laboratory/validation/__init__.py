"""Public measurements of real cameras, repeated on the simulated sensors."""
