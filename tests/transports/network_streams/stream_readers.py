"""Real and independent clients of streams on a network, as readers of the contract of links."""

import contextlib
import queue
import socket
import struct
import threading
import time

import dv_processing as dv
import numpy as np

from firmware_protocol.events import EVENT


class DvReader:
    """dv_processing's own network client."""

    def __init__(self, link):
        host, _, port = link.report.address.rpartition(":")
        self.client = dv.io.NetworkReader(host, int(port))
        while "waiting" in link.listen().state:
            time.sleep(0.01)

    def read(self, count):
        batches, have, until = [], 0, time.monotonic() + 120
        while have < count:
            batch = self.client.getNextEventBatch()
            if batch is None:
                assert time.monotonic() < until, f"only {have} of {count} events came"
                time.sleep(0.001)
                continue
            batches.append(events_of(batch))
            have += len(batches[-1])
        return np.concatenate(batches)

    def close(self):
        self.client = None


def events_of(batch):
    """Return a batch of dv_processing as EVENT."""
    records = batch.numpy()
    events = np.zeros(len(records), EVENT)
    for ours, theirs in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("on", "polarity")):
        events[ours] = records[theirs]
    return events


def caer_packets(data):
    """Yield (kind, wraps, [(word, t), ...]) of AEDAT 3.1 packets; written from the documents of libcaer alone."""
    at = 0
    while at < len(data):
        kind, _, size, time_at, wraps, _, number, _ = struct.unpack_from("<hhiiiiii", data, at)
        assert (size, time_at) == (8, 4)
        yield kind, wraps, [struct.unpack_from("<Ii", data, at + 28 + 8 * n) for n in range(number)]
        at += 28 + 8 * number


def caer_events(data):
    """Return the polarity events of whole packets as a list of (t, x, y, on)."""
    return [
        ((wraps << 31) + t, word >> 17, word >> 2 & 0x7FFF, bool(word >> 1 & 1))
        for kind, wraps, records in caer_packets(data)
        if kind == 1
        for word, t in records
    ]


class _Bytes:
    """A thread that reads a TCP stream to its end, so that the link does not wait while its bytes are decoded."""

    def __init__(self, link):
        host, _, port = link.report.address.rpartition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=120)
        self._pieces, self._held = queue.SimpleQueue(), bytearray()
        self._thread = threading.Thread(target=self._take)
        self._thread.start()
        while "waiting" in link.listen().state:
            time.sleep(0.01)

    def _take(self):
        with contextlib.suppress(OSError):  # it was closed here, or by the link
            while piece := self._socket.recv(1 << 20):
                self._pieces.put(piece)
        self._pieces.put(b"")

    def exactly(self, size):
        while len(self._held) < size:
            piece = self._pieces.get(timeout=120)
            assert piece, "the link closed the connection"
            self._held += piece
        data = bytes(self._held[:size])
        del self._held[:size]
        return data

    def close(self):
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()


class CaerReader(_Bytes):
    """A client of cAER's TCP stream."""

    def read(self, count):
        magic, number, version, form, _ = struct.unpack("<qqbbh", self.exactly(20))
        assert (magic, number, version, form) == (0x1D378BC90B9A6658, 0, 1, 0)
        events = []
        while len(events) < count:
            head = self.exactly(28)
            events += caer_events(head + self.exactly(8 * struct.unpack_from("<i", head, 20)[0]))
        return np.array(events, EVENT)


def udp_port():
    """Return a UDP socket with a large buffer on a free port of the loopback interface."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (33, socket.SO_RCVBUF):  # SO_RCVBUFFORCE goes beyond the machine's limit, where that is allowed
        with contextlib.suppress(OSError):
            receiver.setsockopt(socket.SOL_SOCKET, option, 8 << 20)
            break
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(0.05)
    return receiver


class DatagramReader:
    """A thread that takes datagrams at once, and decodes them with `decode`, from the documents alone."""

    def __init__(self, receiver, decode):
        self._socket = receiver
        self._decode = decode
        self._datagrams = queue.SimpleQueue()
        self._open = True
        self._thread = threading.Thread(target=self._take)
        self._thread.start()

    def _take(self):
        while self._open:
            with contextlib.suppress(TimeoutError):
                self._datagrams.put(self._socket.recv(65536))

    def read(self, count):
        events = []
        while len(events) < count:
            events += self._decode(self._datagrams.get(timeout=120))
        return np.array(events, EVENT)

    def close(self):
        self._open = False
        self._thread.join()
        self._socket.close()


class JaerDecoder:
    """jAER's receiver: checks the numbers, turns the picture back."""

    def __init__(self, size=(346, 260)):
        self._size = size
        self._next = 1

    def __call__(self, datagram):
        (number,) = struct.unpack_from(">i", datagram)
        assert number == self._next
        self._next += 1
        return [self._event(*record) for record in struct.iter_unpack(">Ii", datagram[4:]) if not record[0] >> 10 & 1]

    def _event(self, word, t):
        x, y = self._size[0] - 1 - (word >> 12 & 0x3FF), self._size[1] - 1 - (word >> 22 & 0x1FF)
        return t, x, y, bool(word >> 11 & 1)


class CaerDatagrams:
    """cAER's receiver: puts packets together again."""

    def __init__(self):
        self._next = 0
        self._packet = b""

    def __call__(self, datagram):
        magic, number, version, form, _ = struct.unpack_from("<QQbbh", datagram)
        assert (magic, number & ~(1 << 63), version, form) == (0x1D378BC90B9A6658, self._next, 1, 0)
        assert bool(number >> 63) == (not self._packet)
        self._next += 1
        self._packet += datagram[20:]
        if len(self._packet) < 28 + 8 * struct.unpack_from("<i", self._packet, 20)[0]:
            return []
        packet, self._packet = self._packet, b""
        return caer_events(packet)


def long_events(datagram):
    """Return the events of faery's t64_x16_y16_on8."""
    return [(t, x, y, on) for t, x, y, on in struct.iter_unpack("<QHH?", datagram)]


def short_events(datagram):
    """Return the events of faery's t32_x16_y15_on1."""
    return [(t, x, y_on >> 1, bool(y_on & 1)) for t, x, y_on in struct.iter_unpack("<IHH", datagram)]
