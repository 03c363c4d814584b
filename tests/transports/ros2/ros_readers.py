"""Readers of topics: CycloneDDS in another process, rosbags for the messages, evt3 for the events."""

import itertools
import os
import queue
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import evt3
import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.events import EVENT

PEER = Path(__file__).with_name("peer.py")
# Of ros-event-camera/event_camera_msgs.
EVENT_PACKET = """
std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
SIZE = (346, 260)
DOMAIN = 8 + os.getpid() % 92  # ports below those that the kernel gives to any socket
_NUMBERS = itertools.count()


def own_topic(name="events"):
    """Return a topic that no other test has."""
    return f"/evstim_{os.getpid()}_{next(_NUMBERS)}/{name}"


def typestore():
    """Return rosbags' types of ROS 2 with that of packets of events."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(EVENT_PACKET, "event_camera_msgs/msg/EventPacket"))
    return types


class Peer:
    """A process that reads a topic."""

    def __init__(self, topic, kind="EventPacket", reliability="reliable", domain=DOMAIN):
        self.process = subprocess.Popen(
            [sys.executable, str(PEER), "read", str(domain), topic, kind, reliability],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        self.messages = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._read_on)
        self._thread.start()

    def _read_on(self):
        while head := self.process.stdout.read(4):
            self.messages.put(self.process.stdout.read(struct.unpack("<I", head)[0]))

    def matched(self):
        assert self.process.stderr.readline() == b"matched\n"
        return self

    def close(self):
        self.process.kill()
        self.process.wait()
        self._thread.join()
        self.process.stdout.close()
        self.process.stderr.close()


class EventReader(Peer):
    """Reads packets of events."""

    types = typestore()

    def __init__(self, link, topic, **which):
        super().__init__(topic, **which)
        while "waiting" in link.listen().state:
            time.sleep(0.01)
        self.packets = []

    def read(self, count):
        have, until = 0, time.monotonic() + 120
        while have < count:
            assert time.monotonic() < until, f"only {have} of {count} events came"
            packet = self.types.deserialize_cdr(self.messages.get(timeout=120), "event_camera_msgs/msg/EventPacket")
            have += events_in(packet)
            self.packets.append(packet)
        return decoded(self.packets)


def events_in(packet):
    """Return the number of events of a packet: of words with a single column, or of 64-bit words."""
    if packet.encoding == "mono":
        return len(packet.events) // 8
    return int(np.count_nonzero(packet.events.view("<u2") >> 12 == 2))


def decoded(packets):
    """Return the events of packets by evt3, or of "mono" words from the definition of event_camera_codecs."""
    events = np.zeros(sum(map(events_in, packets)), EVENT)
    if packets[0].encoding == "mono":
        words = [(int(w), p.time_base) for p in packets for w in p.events.view("<u8")]
        events["t"] = [(base + (w & 0xFFFFFFFF)) // 1000 for w, base in words]
        events["x"] = [w >> 32 & 0xFFFF for w, _ in words]
        events["y"] = [w >> 48 & 0x7FFF for w, _ in words]
        events["on"] = [w >> 63 for w, _ in words]
        return events
    head = b"% evt 3.0\n% format EVT3;width=346;height=260\n% geometry 346x260\n% end\n"
    read = evt3.decode_bytes(head + b"".join(p.events.tobytes() for p in packets), *SIZE)
    events["t"], events["x"], events["y"], events["on"] = read.t, read.x, read.y, read.p
    return events
