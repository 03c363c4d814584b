"""Feeds the module evstim_v4l2 with words, at once whenever a client has a buffer: v4l2_words.py SENSOR PID_FILE

SENSOR is imx636 or genx320. Requests are executed on registers that only store; PID_FILE gets the number of the
process. With a number in its place, that many messages of random octets, kinds and lengths are written in between, and
it ends with the number of those that the module took.
"""

import contextlib
import os
import random
import select
import struct
import sys
from pathlib import Path

from firmware_protocol.genx320 import registers as genx320
from firmware_protocol.imx636 import registers as imx636
from firmware_protocol.prophesee.v4l2 import REQUEST_BYTES, WORDS_HEADER, NodeSettings, Request, RequestKind, answer

FILE = "/dev/evstim-v4l2"
SENSORS = {"imx636": imx636.V4L2_SENSOR, "genx320": genx320.V4L2_SENSOR}


class Registers(dict[int, int]):
    """Registers that store what is written."""

    def read_register(self, address):
        return self.get(address, 0)

    def write_register(self, address, value):
        self[address] = value


def feed(sensor):
    file = os.open(FILE, os.O_RDWR | os.O_NONBLOCK)
    settings = NodeSettings(sensor, Registers())
    os.write(file, sensor.description("0badcafe", 65536))
    poll = select.poll()
    poll.register(file, select.POLLIN)
    streams = False
    while True:
        ready = dict(poll.poll(1000)).get(file, 0)
        if ready & select.POLLIN:
            request = Request.parse(os.read(file, REQUEST_BYTES))
            if request.kind == RequestKind.STREAM:
                streams = bool(request.value)
            elif request.kind != RequestKind.FORMAT:
                settings.apply(request)
            os.write(file, answer())
            poll.modify(file, select.POLLIN | (select.POLLOUT if streams else 0))
        elif ready & select.POLLOUT:
            with contextlib.suppress(BlockingIOError):
                os.writev(file, [WORDS_HEADER, bytes(4096)])


def attack(sensor, count):
    """Write hostile messages, before a sensor is described and after, and return how many the module took."""
    draw = random.Random(1)
    description = sensor.description("0badcafe", 65536)
    taken, file = 0, os.open(FILE, os.O_RDWR | os.O_NONBLOCK)
    for number in range(count):
        if number % 500 == 0:  # devices come and go
            os.close(file)
            file = os.open(FILE, os.O_RDWR | os.O_NONBLOCK)
            if number % 1000:
                os.write(file, description)
        message = bytearray(description if draw.random() < 0.01 else struct.pack("=I", draw.choice((1, 2, 3, 3, 99))))
        message += draw.randbytes(draw.choice((0, 1, 4, 4, 300, 5000)) if len(message) == 4 else 0)
        for _ in range(draw.randrange(3)):
            message[draw.randrange(len(message))] = draw.randrange(256)
        with contextlib.suppress(OSError):
            os.write(file, message[: draw.randrange(len(message) + 1)] if draw.random() < 0.1 else message)
            taken += 1
        with contextlib.suppress(OSError):
            os.read(file, draw.choice((REQUEST_BYTES, 0, 10_000)))
    os.close(file)
    return taken


if __name__ == "__main__":
    if sys.argv[2].isdigit():
        print(attack(SENSORS[sys.argv[1]], int(sys.argv[2])))
    else:
        Path(sys.argv[2]).write_text(str(os.getpid()))
        feed(SENSORS[sys.argv[1]])
