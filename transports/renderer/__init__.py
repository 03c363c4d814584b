"""Carriers of external renderers' images: a socket, and memory shared on one machine."""
