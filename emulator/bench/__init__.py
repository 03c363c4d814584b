"""The speeds that the docs quote, measured on this machine."""
