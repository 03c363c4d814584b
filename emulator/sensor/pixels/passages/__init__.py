"""Events of pixels with noise: first passages, found for all pixels of a table at once."""
