"""Links that write a recording."""
