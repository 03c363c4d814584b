"""The three checksums of the packet and framing standards, over whole byte strings.

    name               polynomial   start        reflected  final xor   of "123456789"  used by
    CRC-16-CCITT-FALSE 0x1021       0xFFFF       no         0           0x29B1          CCSDS, PUS packet error control
    CRC-32             0x04C11DB7   0xFFFFFFFF   yes        0xFFFFFFFF  0xCBF43926      F Prime, Ethernet, zlib
    CRC-32C            0x1EDC6F41   0xFFFFFFFF   yes        0xFFFFFFFF  0xE3069283      libcsp (csp_crc32.c), iSCSI

The standard library has the first two. CRC-32C is computed 64 bytes at a time: the remainder of a row of bytes is the
exclusive or of one table entry per byte and place, which numpy gathers for all rows at once; only the register passed
from row to row is a loop.
"""

from __future__ import annotations

from binascii import crc_hqx
from zlib import crc32 as _zlib_crc32

import numpy as np
import numpy.typing as npt

_CASTAGNOLI_REFLECTED = 0x82F63B78
_ROW = 64


def crc16(data: bytes) -> int:
    """CRC-16-CCITT-FALSE of `data`; zero over data that end in their own big-endian checksum."""
    return crc_hqx(data, 0xFFFF)


def crc32(data: bytes) -> int:
    """CRC-32 of `data`, as zlib and F Prime compute it."""
    return _zlib_crc32(data)


def _byte_table() -> npt.NDArray[np.uint32]:
    """Remainder of each single byte, shape (256,)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        odd = (table & 1).astype(bool)
        table >>= 1
        table[odd] ^= _CASTAGNOLI_REFLECTED
    return table


def _place_tables() -> npt.NDArray[np.uint32]:
    """Remainder of each byte at each place of a row, shape (_ROW, 256): _ROW - 1 - p bytes follow place p."""
    tables = np.empty((_ROW, 256), np.uint32)
    tables[-1] = byte = _byte_table()
    for place in range(_ROW - 2, -1, -1):
        tables[place] = byte[tables[place + 1] & 0xFF] ^ (tables[place + 1] >> 8)
    return tables


_TABLES = _place_tables()
_FIRST, _SECOND, _THIRD, _FOURTH = (table.tolist() for table in _TABLES[:4])
_BYTE: list[int] = _TABLES[-1].tolist()
_PLACES = np.arange(_ROW)


def _short(data: bytes) -> int:
    """CRC-32C byte by byte, for less than a register's worth of data."""
    register = 0xFFFFFFFF
    for byte in data:
        register = _BYTE[(register ^ byte) & 0xFF] ^ (register >> 8)
    return register ^ 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli) of `data`, as libcsp computes it."""
    if len(data) < 4:
        return _short(data)
    # Leading zeros leave a register of zero unchanged, so the start value goes into the first four bytes instead.
    padding = -len(data) % _ROW
    rows = np.zeros(padding + len(data), np.uint8)
    rows[padding:] = np.frombuffer(data, np.uint8)
    rows[padding : padding + 4] ^= 0xFF
    remainders = np.bitwise_xor.reduce(_TABLES[_PLACES, rows.reshape(-1, _ROW)], axis=1)
    register = 0
    for remainder in remainders.tolist():
        register = (
            remainder
            ^ _FIRST[register & 0xFF]
            ^ _SECOND[register >> 8 & 0xFF]
            ^ _THIRD[register >> 16 & 0xFF]
            ^ _FOURTH[register >> 24]
        )
    return register ^ 0xFFFFFFFF
