"""Cameras with Sony and Prophesee's IMX636: the core that they share, the EVK4 (USB) and the Triton2 (GigE Vision)."""
