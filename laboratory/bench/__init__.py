"""Speeds: the measures of `evstim bench`, and programs that print tables, `python -m laboratory.bench.NAME`."""
