"""The live table and the summary of a run."""
