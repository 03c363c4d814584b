"""How many bits each register of a DAVIS346 keeps, typed from the published logic and not taken from the model."""

__all__ = ["WIDTHS", "kept"]

# (module, first and last parameter): bits, as the published logic declares them for this chip and its clocks.
WIDTHS = {
    (0, 0, 5): 1, (1, 3, 5): 1, (1, 11, 26): 9, (1, 31, 31): 1, (1, 32, 32): 12, (1, 33, 33): 1, (1, 34, 34): 12,
    (1, 41, 44): 9, (1, 51, 51): 1, (1, 52, 52): 8, (1, 61, 63): 1, (2, 4, 5): 1, (2, 7, 7): 1, (2, 8, 11): 9,
    (2, 12, 12): 27, (2, 13, 13): 28, (3, 2, 4): 1, (3, 5, 5): 8, (3, 6, 6): 3, (3, 7, 7): 2, (3, 9, 9): 3,
    (3, 10, 10): 2, (4, 0, 4): 1, (4, 5, 5): 27, (4, 11, 12): 1, (4, 13, 14): 27, (4, 15, 16): 1, (5, 0, 4): 9,
    (5, 8, 27): 15, (5, 34, 34): 15, (5, 35, 36): 16, (5, 128, 135): 4, (5, 136, 144): 1, (9, 0, 0): 1, (9, 1, 1): 27,
}  # fmt: skip


def kept(module, address, value):
    """Return what a register keeps of a 32-bit value."""
    (bits,) = (n for (of, first, last), n in WIDTHS.items() if of == module and first <= address <= last)
    return value & (1 << bits) - 1
