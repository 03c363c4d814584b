"""A Prophesee camera on USB as a sensor on Linux's camera interface (V4L2), for programs that read no USB.

    camera on USB  <-- words, registers -->  this program  <-- messages -->  evstim_v4l2.ko  <-- V4L2 -->  the client

The module and its messages are those of `firmware_protocol.prophesee.v4l2`. A client that queues no buffers stops the
camera's stream, as a slow host on USB does: the camera buffers, drops, and counts what it dropped. A receiver of MIPI
would lose the words itself, uncounted.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from firmware_protocol.prophesee.treuzell import Property
from firmware_protocol.prophesee.v4l2 import REQUEST_BYTES, WORDS_HEADER, NodeSettings, Request, RequestKind, answer
from transports.usb.host import PeerGone, StreamSettings, UnsuitableDevice, UsbHostError
from transports.usb.treuzell_host import TreuzellHost

MODULE_FILE = "/dev/evstim-v4l2"
_STREAM = StreamSettings(transfer_bytes=65_536, transfers=8, edges=True)
"""Few transfers in flight: a setting waits until those that are before it on the connection have come."""
_WAIT_S = 0.01
_IDLE_S = 0.5


class NodeError(Exception):
    """The kernel module's file cannot be used; the message has the reason and the remedy."""


@dataclass
class Forwarded:
    """Counts of a node: octets of words, buffers, streams that clients started, and settings that they made."""

    octets: int = 0
    buffers: int = 0
    streams: int = 0
    settings: int = 0
    gone: bool = False


class Node:
    """The devices of one camera, from construction to `close`. Raises NodeError, UnsuitableDevice, UsbHostError.

    `counts` are those so far.

    Parameters
    ----------
    file : descriptor of the module's file, from `opened`; it is closed with the node.
    buffer_bytes : size of the client's buffers, a multiple of 8.
    """

    def __init__(self, camera: TreuzellHost, file: int, buffer_bytes: int) -> None:
        if camera.node is None:
            raise UnsuitableDevice(f"{camera.model}: no driver on V4L2 is known for its sensor")
        self.counts = Forwarded()
        self._camera = camera
        self.sensor = camera.node
        self._settings = NodeSettings(self.sensor, camera)
        self._form = self.sensor.formats[0].form
        self._buffer_bytes = buffer_bytes
        self._streams = False
        self._waiting = memoryview(b"")
        self._fd = file
        try:
            os.write(file, self.sensor.description(camera.info.serial, buffer_bytes))
        except OSError as error:
            raise NodeError(f"the module refuses the sensor, perhaps an older one is loaded: {error}") from error

    def run(self, goes_on: Callable[[Forwarded], bool]) -> None:
        """Forward words and settings while `goes_on`, called in each turn, returns True, and the camera is there."""
        try:
            while goes_on(self.counts):
                self._turn()
        except PeerGone:
            self.counts.gone = True

    def close(self) -> None:
        """Remove the devices; a client that still has one open gets ENODEV."""
        os.close(self._fd)
        if self._streams:
            with contextlib.suppress(UsbHostError):
                self._camera.stop_words()

    def _turn(self) -> None:
        poll = select.poll()
        poll.register(self._fd, select.POLLIN | (select.POLLOUT if self._waiting else 0))
        # With words to forward, the wait is at the camera; a request of the client then waits as long at most.
        wait_s = 0.0 if self._streams and not self._waiting else _WAIT_S if self._streams else _IDLE_S
        ready = dict(poll.poll(1000 * wait_s)).get(self._fd, 0)
        if ready & select.POLLIN:
            self._answer_request()
        if self._waiting and ready & select.POLLOUT:
            self._write_words()
        elif self._streams and not self._waiting:
            self._waiting = memoryview(b"".join(self._transfers()))
            self._write_words()
        elif not self._streams and not ready:
            self._camera.request(Property.RELEASE)  # without a stream, a lost camera shows at a request alone

    def _transfers(self) -> Iterator[bytes]:
        """Yield what the camera has sent, a buffer at most: a client that lags gets fewer buffers, and fuller ones."""
        octets, wait_s = 0, _WAIT_S
        while octets < self._buffer_bytes and (words := self._camera.read_words(wait_s)) is not None:
            octets, wait_s = octets + len(words), 0.0
            yield words

    def _write_words(self) -> None:
        """Give the kernel the words that wait, as far as the client has queued buffers."""
        while self._waiting:
            try:
                taken = os.writev(self._fd, [WORDS_HEADER, self._waiting[: self._buffer_bytes]])
            except BlockingIOError:
                return
            octets = taken - len(WORDS_HEADER)
            self._waiting = self._waiting[octets:]
            self.counts.octets += octets
            self.counts.buffers += 1

    def _answer_request(self) -> None:
        try:
            request = Request.parse(os.read(self._fd, REQUEST_BYTES))
        except BlockingIOError:
            return  # the client was interrupted meanwhile
        try:
            self._execute(request)
        except OSError as error:
            self._reply(error.errno or errno.EIO)
        except UsbHostError:
            self._reply(errno.EIO)
            raise
        else:
            self._reply(0)

    def _execute(self, request: Request) -> None:
        if request.kind == RequestKind.STREAM:
            self._stream(on=bool(request.value))
        elif request.kind == RequestKind.FORMAT:
            self._form = self.sensor.formats[request.id].form
        else:
            self._settings.apply(request)
            self.counts.settings += 1

    def _stream(self, *, on: bool) -> None:
        if on:
            self._camera.start_words(self._form, _STREAM)
            self.counts.streams += 1
        else:
            self._camera.stop_words()
        self._streams, self._waiting = on, memoryview(b"")

    def _reply(self, error: int) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._fd, answer(error))


def opened(file: str) -> int:
    """Open the module's file; raises NodeError."""
    try:
        return os.open(file, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise NodeError(f"no {file}: build and load the module evstim_v4l2, see docs/cameras.md") from error
    except PermissionError as error:
        raise NodeError(f"{file} can be opened by root alone: use sudo, or change its mode") from error
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise NodeError(f"{file}: another program feeds a camera there; end it first") from error
        raise NodeError(f"{file}: {error}") from error
