"""Poses of cameras and bodies at any instant."""
