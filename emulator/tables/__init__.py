"""TOML tables turned into frozen dataclasses, with messages that name the key."""
