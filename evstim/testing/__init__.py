"""Contract suites and fakes for those who extend evstim; importing them needs pytest."""
