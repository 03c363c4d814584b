"""Definitions of the instrument's packets for ground systems, written from the types that the code packs and reads."""
