"""A receiver of the DAVIS346's words: the same events for any cut of the bytes, edges, and resets counted."""

import numpy as np
import pytest

from firmware_protocol.events import EdgeKind
from firmware_protocol.fx3.words import Special
from firmware_protocol.receiver.instrument import DavisReceiver

# Words as the published logic writes them: reset, time 5, row 3, ON column 7, rising edge at 9, wrap, OFF column 300.
WORDS = [1, 0x8005, 0x1003, 0x3007, 0x8009, int(Special.INPUT_RISING), 0x7001, 0x8002, 0x2000 + 300]
EVENTS = [(5, 7, 3, True), (32768 + 2, 300, 3, False)]


@pytest.mark.parametrize("step", [1, 2, 3, 100])
def test_any_cut_of_the_bytes_gives_the_same(step):
    data, receiver = np.array(WORDS, "<u2").tobytes(), DavisReceiver()
    for at in range(0, len(data), step):
        receiver.push(data[at : at + step])
    assert receiver.take_events().tolist() == EVENTS
    assert receiver.take_edges()[["t", "kind"]].tolist() == [(9, EdgeKind.RISING)]
    assert receiver.counts == {"bytes": 18, "events": 2, "edges": 1, "resets": 1}
    assert receiver.faults == 0
    assert receiver.take_reports() == ()


def test_words_that_no_camera_sends_are_faults():
    receiver = DavisReceiver()
    receiver.push(np.array([0x8005, 0x1003, 0x2000 + 400], "<u2").tobytes())
    assert len(receiver.take_events()) == 0
    assert receiver.counts["column_outside"] == receiver.faults == 1
