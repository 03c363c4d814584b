"""Decisions before a run: which effects to model, how long the steps are, and why."""
