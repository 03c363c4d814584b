"""Temporal noise: rms and poles, hazard of a first passage, rates in still light; `pixels.passage` applies it."""
