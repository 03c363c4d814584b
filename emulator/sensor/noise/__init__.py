"""Temporal noise: rms and poles, hazard of a first passage, rates in still light; `passages` applies it."""
