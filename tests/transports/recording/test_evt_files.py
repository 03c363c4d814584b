"""`.raw` files of each version and text that Prophesee's programs write, by our reader."""

import numpy as np
import pytest

from firmware_protocol.evt.evt2 import Evt2Encoder, evt2_header
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.evt.words import evt3_header
from firmware_protocol.recordings.part import Facts
from tests.transports.recording.samples import SIZE, sample_edges, sample_events
from transports.recording.part import RecordingError
from transports.recording.word_files import Evt21LegacyWriter, EvtReader

EVENTS = sample_events()
EDGES = sample_edges(EVENTS)
TEXTS = [
    ("evt3", evt3_header(SIZE)),
    ("evt3", b"% evt 3.0\n% geometry 346x260\n"),
    ("evt3", b"% format EVT3;height=260;width=346\n% end\n"),
    ("evt3", b"% geometry 346x260\n% end\n"),
    ("evt2", evt2_header(SIZE, "evt2")),
    ("evt2", b"% evt 2.0\n% geometry 346x260\n"),
    ("evt21", evt2_header(SIZE, "evt21")),
    ("evt2", b"% evt 2.0\n% format EVT2;width=346;height=260\n% end\n"),
    ("evt21", b"% endianness little\n% format EVT21;height=260;width=346\n% geometry 346x260\n% end\n"),
    ("evt21", b"% evt 2.1\n% geometry 346x260\n% end\n"),
    ("evt21-legacy", evt2_header(SIZE, "evt21-legacy")),
    ("evt21-legacy", b"% evt 2.1\n% endianness legacy\n% geometry 346x260\n% end\n"),
    ("evt21-legacy", b"% format EVT21;height=260;width=346;endianness=legacy\n% end\n"),
]


@pytest.mark.parametrize(("form", "text"), TEXTS)
def test_the_text_tells_words_and_size(form, text, tmp_path):
    encoder = Evt3Encoder() if form == "evt3" else Evt2Encoder(form)
    path = tmp_path / "a.raw"
    path.write_bytes(text + encoder.encode(EVENTS, EDGES))
    reader = EvtReader(path, None)
    parts = list(reader.parts())
    assert reader.facts.size == SIZE
    assert reader.facts.camera == form
    np.testing.assert_array_equal(np.concatenate([part.events for part in parts]), EVENTS)
    np.testing.assert_array_equal(np.concatenate([part.edges for part in parts]), EDGES)


def test_the_text_is_what_openeb_writes_for_these_words(tmp_path):
    """Its lines in its order (psee_raw_file_header.cpp of 5.1.1), without those of the camera and the program."""
    Evt21LegacyWriter(tmp_path / "a.raw", Facts(SIZE)).close()
    assert (tmp_path / "a.raw").read_bytes() == (
        b"% endianness legacy\n% format EVT21;endianness=legacy;height=260;width=346\n% geometry 346x260\n% end\n"
    )


EVK4 = b"""% camera_integrator_name Prophesee
% date 2023-03-29 16:37:46
% evt 3.0
% format EVT3;height=720;width=1280
% geometry 1280x720
% plugin_name hal_plugin_imx636_evk4
% serial_number 00ca0009
% end
"""


def test_date_serial_number_and_plug_in_of_the_text_are_facts(tmp_path):
    (tmp_path / "a.raw").write_bytes(EVK4 + Evt3Encoder().encode(EVENTS))
    assert EvtReader(tmp_path / "a.raw", None).facts.header == {
        "camera_integrator_name": "Prophesee", "date": "2023-03-29 16:37:46", "plugin_name": "hal_plugin_imx636_evk4",
        "serial_number": "00ca0009",
    }  # fmt: skip


@pytest.mark.parametrize(("form", "octets"), [("evt3", 1), ("evt2", 3), ("evt21", 7)])
def test_a_cut_word_is_damage_after_the_events_before_it(form, octets, tmp_path):
    encoder, head = (Evt3Encoder(), EVK4) if form == "evt3" else (Evt2Encoder(form), evt2_header(SIZE, form))
    (tmp_path / "a.raw").write_bytes(head + encoder.encode(EVENTS[:100]) + bytes(octets))
    parts = EvtReader(tmp_path / "a.raw", None).parts()
    assert len(next(parts).events) == 100
    with pytest.raises(RecordingError, match=f"{octets} octets of a cut record at the end"):
        list(parts)
