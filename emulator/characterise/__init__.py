"""Characterises a simulated sensor as a laboratory characterises a real one."""
