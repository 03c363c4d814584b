"""Packets of the instrument's link: what it says, what it is told, and the standards that carry both."""
