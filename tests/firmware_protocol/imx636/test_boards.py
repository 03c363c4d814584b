"""The boards beside the EVK4: each has what drivers compare, and streams; an EVK3 HD takes frames without a size."""

import struct

import pytest
from evk4_requests import ANSWERS, START, Host, events_of
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.imx636.evk4 import BOARDS, Evk4, Evk4Settings
from firmware_protocol.usb.device import SetupPacket
from transports.usb.cameras import driver_of
from transports.usb.loopback import DirectHost
from transports.usb.treuzell_host import TreuzellHost

# Strings in the library of neuromorphic_drivers 0.18.2; ids and kinds in the source of 0.16.1 and issue 5.
AS_LISTED = {
    "evk4": ("04b4:00f5", 0x31, "Prophesee", "EVK4"),
    "evk3_hd": ("04b4:00f5", 0x30, "Prophesee", "EVK3"),
    "silkyevcam_hd": ("31f7:0003", 0x31, "CenturyArks", "SilkyEvCam HD v03.09.00C"),
    "silkyevcam_hd_lite": ("31f7:0004", 0x35, "CenturyArks", "SilkyEvCam HD Lite v03.09.01C"),
    "ueye_xcp_e": ("1409:8e00", 0x31, "IDS Imaging Development Systems GmbH", "UE-39B0XCP"),
    "ueye_xls_e": ("1409:8e00", 0x31, "IDS Imaging Development Systems GmbH", "UE-39B2XLS"),
}
# What OpenEB 5.1.1 compares before it builds the device: a name, registers 0014, F128 & 3.
AS_BUILT = {
    "evk3_hd": ("psee,ccam5_gen41", 0xA030_1003, 0),
    "silkyevcam_hd_lite": ("psee,ccam5_imx646", 0xA040_1806, 2),
}
IMX636 = ("psee,ccam5_imx636", 0xA040_1806, 0)

boards = pytest.mark.parametrize("name", BOARDS)


def board(name, **changes):
    return Evk4(Evk4Settings(serial="c0ffee", start_delay_us=0, board=BOARDS[name], **changes))


@boards
def test_a_driver_lists_it(name):
    usb_id, kind, *strings = AS_LISTED[name]
    camera = board(name)
    host = Host(camera)
    device = camera.control(SetupPacket(0x80, 6, 0x0100, 0, 18), b"")
    assert "{1:04x}:{0:04x}".format(*struct.unpack_from("<HH", device, 8)[::-1]) == usb_id
    assert f"{camera.identity.vendor_id:04x}:{camera.identity.product_id:04x}" == usb_id
    read = [camera.control(SetupPacket(0x80, 6, 0x0300 + k, 0x409, 255), b"") for k in (1, 2)]
    assert [text[2:].decode("utf-16-le") for text in read] == strings
    assert camera.control(SetupPacket(0xC0, 0x72, 0, 0, 2), b"")[0] == kind
    assert host.ask("72000000 00000000") == "72000000 08000000 eeffc000 00000000"


@boards
def test_openeb_finds_its_sensor(name):
    compatible, number, variant = AS_BUILT.get(name, IMX636)
    host = Host(board(name))
    assert compatible in bytes.fromhex(host.ask("03000100 04000000 00000000"))[12:].decode().split("\0")
    assert (host.register(0x0014), host.register(0xF128) & 3) == (number, variant)


@boards
def test_it_streams_to_our_own_driver(name):
    camera = board(name)
    host = driver_of(DirectHost(camera))
    assert isinstance(host, TreuzellHost)
    assert BOARDS[name].title in host.model.split(" or ")
    host.write_register(0x7000, 0x0007_0003)  # as another program left it
    host.start()
    events = events_of((10, 1, 2, True), (11, 1279, 719, False))
    camera.offer(events)
    assert host.read(0.2).tolist() == events.tolist()
    host.close()
    assert not camera.streaming


def short(host, *words):
    host.camera.write(2, struct.pack(f"<{len(words)}I", *words))
    transfer = host.camera.read(ANSWERS, 16)  # neuromorphic_drivers reads 16 octets
    host.camera.sent(transfer)
    return struct.unpack("<3I", transfer.data)


def test_an_evk3_takes_registers_without_a_size():
    host = Host(board("evk3_hd"))
    assert short(host, 0x56, 0x1010, 0x01A1_6380) == (0x56, 0x1010, 0x01A1_6380)
    assert host.camera.biases["diff_on"] == 0x80
    assert short(host, 0x55, 0x1010) == (0x55, 0x1010, 0x01A1_6380)
    assert short(host, 0x55, 0x0800) == (0x55, 0x0800, 0)
    assert short(host, 0x56, 0x41_0000, 7) == (0x56, 0x41_0000, 0)  # there is no register
    assert host.register(0x1010) == 0x01A1_6380  # nor do frames with a size end


def test_an_evk3_starts_by_frames_without_a_size():
    camera = board("evk3_hd")
    host = Host(camera)
    for address, value in START:
        short(host, 0x56, address, value)
    camera.offer(events_of((7, 1, 2, False)))
    assert host.words() == [0x8000, 0x6007, 0x0002, 0x2001]


def test_its_biases_act_by_their_names():
    host = Host(board("evk3_hd"))
    assert host.camera.sensor_factors == {}
    short(host, 0x56, 0x1018, 0x01A1_3700 | 0x34 + 20)
    assert list(host.camera.sensor_factors) == ["threshold_off"]
    assert host.camera.sensor_factors["threshold_off"] > 1
    short(host, 0x56, 0x1008, 0x0121_0001)
    assert host.camera.without_effect == {"fo_n": "it is not modelled"}


@pytest.mark.parametrize("name", [name for name in BOARDS if name != "evk3_hd"])
def test_the_others_do_not_know_these_frames(name):
    camera = board(name)
    assert Host(camera).ask("56000000 10100000 8063a101") == "00000080 00000000"
    assert camera.biases["diff_on"] == 0x66


@given(
    st.lists(
        st.binary(max_size=16)
        | st.tuples(st.sampled_from([b"\x55\0\0\0", b"\x56\0\0\0"]), st.binary(max_size=12)).map(b"".join)
    )
)
def test_any_bytes_bring_one_answer(requests):
    camera = board("evk3_hd")
    host = Host(camera)
    for data in requests:
        answer = bytes.fromhex(host.ask(data.hex()))
        is_short = (len(data), data[:4]) in ((8, b"\x55\0\0\0"), (12, b"\x56\0\0\0"))
        assert answer[:8] == data[:8] if is_short else int.from_bytes(answer[4:8], "little") == len(answer) - 8
    assert camera.read(ANSWERS, 1024) is None
