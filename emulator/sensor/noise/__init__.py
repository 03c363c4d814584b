"""Temporal noise: its rms and poles, the hazard of a first passage, and rates in still light; `pixels.passage` applies it."""
