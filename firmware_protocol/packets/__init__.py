"""Packets of the instrument's link: messages, telecommands, and the packet standards that carry both."""
