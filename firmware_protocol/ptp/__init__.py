"""Precision Time Protocol (IEEE 1588): messages, a clock in software, and an ordinary clock that is only a slave."""
