"""Scenes that an external renderer draws."""
