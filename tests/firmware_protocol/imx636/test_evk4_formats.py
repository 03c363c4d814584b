"""The words of the format that a host chooses by register 7000, as it may choose it: before a start, or amid events."""

import dataclasses

import numpy as np
from evk4_requests import DATA, START, Host, events_of
from evt2_words import by_the_tables

from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings

PROMPT = Evk4Settings(start_delay_us=0)
EVT3 = ((0x7000, 0x0007_0001), (0x8000, 0x0001_E085))
EVT21 = ((0x7000, 0x0007_0003), (0x8000, 0x0001_E005))  # as OpenEB and Prophesee's Linux driver write them


def running(*entries, **changes):
    camera = Evk4(dataclasses.replace(PROMPT, **changes))
    host = Host(camera)
    host.write(*entries, *START)
    return camera, host


def octets(camera, max_bytes=131_072):
    pieces = []
    while (transfer := camera.read(DATA, max_bytes)) is not None:
        camera.sent(transfer)
        pieces.append(transfer.data)
    return pieces


def test_the_octets_of_some_events():
    camera, _ = running(*EVT21)
    camera.offer(events_of((1_000_000, 64, 100, True), (1_000_000, 67, 100, True), (1_000_003, 64, 100, False)))
    assert b"".join(octets(camera)).hex(" ", 4) == (
        "00000080 00000000 093d0080 00000000 64000210 09000000 6400c200 01000000"  # time 0 and 1 000 000, ON, OFF
    )
    assert camera.counters == Fates(offered=3, delivered=3)


def test_a_host_without_room_for_a_word_gets_none():
    camera, _ = running(*EVT21)
    camera.offer(events_of((1, 1, 1, True)))
    assert camera.read(DATA, 7) is None
    assert camera.counters.queued == 1


def test_edges_and_silence_are_in_the_words():
    camera, _ = running(*EVT21, (0x7004, 0xC5FF))
    edges = make_edges([50, 60, 70], [EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.PULSE])
    camera.offer_edges(edges)
    camera.advance(30_000_000)
    data = b"".join(octets(camera))
    seen = by_the_tables(data, "evt21-legacy")[1]
    assert seen["t"].tolist() == [50, 60, 70, 170]
    assert seen["kind"].tolist() == [EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.RISING, EdgeKind.FALLING]
    edges = camera.counters.edges
    assert (edges.offered, edges.added, edges.delivered) == (3, 1, 4)
    highs = np.frombuffer(data, "<u4")[::2][-3:] & 0x0FFF_FFFF
    assert highs[-1] == 30_000_000 >> 6  # time high alone carries the time


def test_events_that_wait_are_dropped_when_the_format_changes_amid_a_stream():
    camera, host = running()
    camera.offer(events_of((10, 1, 1, True)))
    host.write(*EVT21)
    camera.offer(events_of((20, 2, 2, True), (21, 3, 3, False)))
    seen = by_the_tables(b"".join(octets(camera)), "evt21-legacy")[0]
    assert seen.tolist() == [(20, 2, 2, True), (21, 3, 3, False)]
    host.write(*EVT3)
    camera.offer(events_of((30, 4, 4, True)))
    assert Evt3Decoder().decode(b"".join(octets(camera)))[0].tolist() == [(30, 4, 4, True)]
    assert camera.counters == Fates(offered=4, delivered=3, flushed=1)


def test_the_same_format_again_drops_nothing():
    camera, host = running(*EVT21)
    camera.offer(events_of((10, 1, 1, True)))
    host.write(*EVT21)
    assert by_the_tables(b"".join(octets(camera)), "evt21-legacy")[0].tolist() == [(10, 1, 1, True)]


def test_a_power_on_brings_evt3_back():
    camera, _ = running(*EVT21)
    host = Host(camera)  # attached anew
    host.write(*START)
    camera.offer(events_of((5, 1, 2, False)))
    assert host.words() == [0x8000, 0x6005, 0x0002, 0x2001]
