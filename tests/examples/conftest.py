"""Tests of examples/."""

collect_ignore = ["landing"]  # run by test_examples.py
