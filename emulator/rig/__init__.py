"""Rig files: loading, tables, schema and the table of faults."""
