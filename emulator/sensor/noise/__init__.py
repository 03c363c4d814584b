"""Temporal noise: its rms and poles, the hazard of a first passage, rates in still light; `pixels.passage` applies it."""
