"""How much light leaves a surface, and how much of it there is."""
