"""Temporal noise: its law, as a point process, and followed on a grid."""
