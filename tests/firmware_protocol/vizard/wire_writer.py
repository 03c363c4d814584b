"""Writes protobuf fields by the rules of its encoding, without the library: number, wire type, value."""

import struct

__all__ = ["bsk_update", "field", "update"]

# The first SIM_UPDATE that bsk 2.12.1 sent for examples/basilisk/simulation.py.
_BSK_UPDATE = """
CgsIAREAAAAA0BKDQRKfAQoEZXJvcxIYXD1ERI6LQ8ISvZgQmFooQnimOEuqdRPCGhgFclE2yMPGwK7CPN5na9rAKcPLB3uWssAiSMjgePDt65
m/e+ztGGwa7D8fWTlfnZDev4vJF0iRYta/GKa/QO4k3D/0zjq/hXjqP6Jx01zE9+0/Rtd0JLwPyD/F6k/+V/LSPyk993nnqz89PzHNzMzMzMww
QDkAAAAAAADwPxpWCgZzZWVrZXISGOtZFJSNi0PCR4IEepNaKEIvjcJrpHUTwhoYTiJTNgjDxsBxWjve52rawF5dzwd7l7LAIhhoWoocF5C7vz
blsUleWM6/CbhKVA2Q0z8iVggBEgZzZWVrZXIZ9omH/P22L0AiBNoChAI6GJqZmZmZmck/mpmZmZmZub8AAAAAAADgP0IYgNPyylovxb+bllfW
eqnMPwdUrCQXEeC/SICAkPib+YZHOmUJAAAAAAAA8L+ZAQAAAAAAAPC/yQH4wWMa3KVMwNEBAAAAAAAA8L/hAQAAAAAAAPA/mQIAAAAAAADwv6
ECAAAAAAAA8L/5AgAAAAAAAPC/iQMAAAAAAADwv5AD////////////AUIHCOMPEAEYAVIA
"""


def bsk_update():
    """Return what Basilisk itself wrote: Eros, the spacecraft "seeker" and its camera 1 at 0.04 s."""
    import base64

    return base64.b64decode(_BSK_UPDATE)


def varint(value):
    """Return an unsigned number, seven bits an octet."""
    octets = bytearray()
    while value > 0x7F:
        octets.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(octets) + bytes([value])


def field(number, value):
    """Return one field: int as varint, float as fixed64, text and bytes and packed floats with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value % (1 << 64))
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, (list, tuple)):
        packed = [varint(v % (1 << 64)) if isinstance(v, int) else struct.pack("<d", v) for v in value]
        value = b"".join(packed)
    octets = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(octets)) + octets


def update(t_ns=0.0, spacecraft=(), bodies=(), cameras=()):
    """Return a VizMessage; things as tuples (name, position, rotation), cameras (id, parent, position, direction)."""
    data = field(1, field(1, 1) + field(2, float(t_ns)))
    for number, things in ((3, spacecraft), (2, bodies)):
        for name, position, rotation in things:
            data += field(number, field(1, name) + field(2, position) + field(4, rotation))
    for camera, parent, position, direction in cameras:
        fixed = field(3, 16.0) + field(4, [346, 260])
        data += field(4, field(1, camera) + field(2, parent) + fixed + field(7, position) + field(8, direction))
    return data
