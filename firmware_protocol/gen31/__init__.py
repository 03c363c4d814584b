"""Cameras with Prophesee's Gen 3.1 on USB."""
