"""Opening a serial port, and what to do when that fails."""

from __future__ import annotations

import termios
from contextlib import suppress

import serial
from serial.rs485 import RS485Settings

from transports.serial_line.parameters import SerialParameters
from transports.serial_line.port import DescriptorPort, Port, ThreadedPort
from transports.serial_line.pty_pair import PtyPort

__all__ = ["open_port"]

_STOP_BITS = {1.0: serial.STOPBITS_ONE, 1.5: serial.STOPBITS_ONE_POINT_FIVE, 2.0: serial.STOPBITS_TWO}
_CURES = (
    (
        ("Permission denied",),
        "join the group that owns it (ls -l {port}; usually: sudo usermod -aG dialout $USER) and log in again",
    ),
    (("No such file",), "is it plugged in? `python -m serial.tools.list_ports` lists what there is"),
    (("lock", "busy"), "another program has it; `fuser -v {port}` tells which"),
    (
        ("Connection refused", "timed out", "Name or service"),
        "start what listens there first, and check host and port",
    ),
    (
        ("Invalid argument", "Inappropriate ioctl"),
        "the port cannot do these settings (no pty drives RS-485): leave rs485, parity, stop_bits at the default",
    ),
)
"""What to do, by what the complaint holds; pyserial wraps most errors, so that only their text is left."""


def open_port(line: SerialParameters) -> Port:
    """Open a port; blocks while a network port connects.

    Raises
    ------
    OSError
        It cannot be had; the message says why and what to do.
    """
    if line.port == "pty":
        return PtyPort(line.symlink)
    try:
        opened = _open(line)
    except (OSError, ValueError, termios.error) as error:
        raise OSError(_advice(line.port, error)) from error
    with suppress(OSError):
        opened.fileno()
        return DescriptorPort(opened)
    return ThreadedPort(opened)


def _open(line: SerialParameters) -> serial.SerialBase:
    """Open and set up by pyserial; raises OSError, ValueError or termios.error."""
    opened = serial.serial_for_url(line.port, do_not_open=True)
    opened.baudrate = line.baud
    opened.bytesize, opened.parity, opened.stopbits = line.data_bits, line.parity[0].upper(), _STOP_BITS[line.stop_bits]
    opened.rtscts = line.flow == "rts_cts"
    opened.timeout = 0
    opened.write_timeout = None
    if "://" not in line.port:
        opened.exclusive = True
    opened.open()
    if line.rs485:
        opened.rs485_mode = RS485Settings()
    if line.break_ms:
        opened.send_break(line.break_ms * 1e-3)
    return opened


def _advice(port: str, error: Exception) -> str:
    """Say what to do about a port that does not open."""
    text = str(error)
    cures = [cure for signs, cure in _CURES if any(sign in text for sign in signs)]
    cure = cures[0] if cures else "check the port's name and its settings"
    return f"cannot open {port}: {text}; {cure.format(port=port)}"
