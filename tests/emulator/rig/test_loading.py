"""Rig files: the shipped ones load, and every mistake is told with file, line, key and what would be right."""

import dataclasses
import json
import math

import pytest

from emulator.rig.kinds import CAMERA_MODELS, LINKS, SCENES
from emulator.rig.loading import RigError, find_rig, load_rig, parse_rig, shipped_rigs
from emulator.rig.top_level import rig_schema
from emulator.sensor.presets import PRESETS
from firmware_protocol.genx320.device import SLOPES
from transports.usb.kind import LoopbackLink, UsbipLink

GOOD = """\
title = "t"
[scene]
kind = "checkerboard"
square_px = 20.0
[camera]
model = "davis346"
[camera.sensor]
threshold_on = 0.2
[camera.sensor.readout]
event_ns = 100.0
[run]
step_us = 500
[[links]]
kind = "usbip"
port = 0
[[links]]
kind = "loopback"
"""


def message(text):
    with pytest.raises(RigError) as told:
        parse_rig(text, "my.toml", "my")
    return str(told.value)


def test_there_are_no_other_shipped_rigs():
    assert set(shipped_rigs()) >= {"checkerboard", "eros", "loopback"}
    for name in shipped_rigs():
        assert load_rig(name)


def test_a_rig_is_typed_and_frozen():
    rig = parse_rig(GOOD, "my.toml", "my")
    assert rig.camera.sensor == dataclasses.replace(
        PRESETS["davis346"], threshold_on=0.2, readout=dataclasses.replace(PRESETS["davis346"].readout, event_ns=100.0)
    )
    assert rig.links == (UsbipLink(port=0), LoopbackLink())
    with pytest.raises(dataclasses.FrozenInstanceError):
        rig.run.seed = 3


@pytest.mark.parametrize(
    ("old", "new", "line", "told"),
    [
        ("square_px = 20.0", "sqare_px = 20.0", 4, ["scene.sqare_px", "did you mean 'square_px'"]),
        ("square_px = 20.0", 'square_px = "wide"', 4, ["scene.square_px: must be a number of px, got 'wide'"]),
        ("square_px = 20.0", "square_px = nan", 4, ["scene.square_px", "finite"]),
        ("square_px = 20.0", "square_px = -1", 4, ["scene.square_px", "-1"]),
        ("square_px = 20.0", "dark = 2.0", 4, ["scene.dark", "bright"]),
        ('"checkerboard"', '"chequerboard"', 3, ["scene.kind", "did you mean 'checkerboard'"]),
        ('model = "davis346"', 'model = "davis364"', 6, ["camera.model", "did you mean 'davis346'"]),
        ('model = "davis346"', 'model = "imx636"', 14, ["links[0].kind", "no USB model", "loopback"]),
        ('model = "davis346"', 'serial = "0123456789"', 6, ["camera.serial", "1 to 8"]),
        ("threshold_on = 0.2", "threshold_on = 0.0", 8, ["camera.sensor.threshold_on", "0.0001 to 100"]),
        ("threshold_on = 0.2", "refractory_us = -1.0", 8, ["camera.sensor.refractory_us"]),
        ("threshold_on = 0.2", "width = -5", 8, ["camera.sensor.width"]),
        ("event_ns = 100.0", "evnt_ns = 1.0", 10, ["camera.sensor.readout.evnt_ns", "event_ns"]),
        ("event_ns = 100.0", "event_ns = 0.0", 10, ["camera.sensor.readout.event_ns"]),
        ("step_us = 500", "step_us = 0", 12, ["run.step_us", "1 to"]),
        ("step_us = 500", "step_us = 1.5", 12, ["run.step_us", "a whole number of us"]),
        ("step_us = 500", 'pace = "fast"', 12, ["run.pace", "fast"]),
        ("port = 0", "port = 70000", 15, ["links[0].port", "65535"]),
        ("port = 0", 'busid = "usb1"', 15, ["links[0].busid", "1-1"]),
        ('kind = "loopback"', 'kind = "lopback"', 17, ["links[1].kind", "did you mean 'loopback'"]),
        ("[run]", "[runs]", 11, ["runs", "did you mean 'run'"]),
    ],
)
def test_a_mistake_is_told_with_line_key_and_cure(old, new, line, told):
    assert old in GOOD
    text = message(GOOD.replace(old, new))
    assert f"my.toml, line {line}: " in text
    for part in told:
        assert part in text


def test_a_dvxplorer_has_its_own_inertial_unit():
    rig = load_rig("stars-dvxplorer")
    assert (rig.camera.model, rig.camera.size, rig.camera.imu.unit) == ("dvxplorer", (640, 480), "bmi160")
    text = GOOD.replace('model = "davis346"', 'model = "dvxplorer"').replace("[run]", "[camera.imu]\n[run]")
    assert "camera.imu.unit: a dvxplorer has unit = \"bmi160\", got 'mpu_9250'" in message(text)
    text = GOOD.replace("[run]", '[camera.imu]\nunit = "bmi160"\n[run]')
    assert 'a davis346 has unit = "mpu_9250" or "mpu_6050"' in message(text)


def test_what_is_not_toml_is_told():
    assert "not valid TOML" in message("[scene\n")
    assert "line 1" in message("[scene\n")


def test_a_rig_needs_a_scene():
    assert "needs a [scene]" in message("title = 'x'\n")


def test_links_have_names_and_ports_of_their_own():
    usbip = '[[links]]\nkind = "usbip"\nport = 4000\n'
    scene = '[scene]\nkind = "checkerboard"\n'
    assert "'usbip' is taken" in message(scene + usbip + usbip)
    assert "port 4000 is taken" in message(scene + usbip + usbip + 'name = "other"\n')


def test_two_served_buses_need_ports_of_their_own():
    served = '[[links]]\nkind = "can"\nport = 4000\n'
    scene = '[scene]\nkind = "checkerboard"\n'
    assert "port 4000 is taken" in message(scene + served + served + 'name = "other"\n')
    joined = served.replace("port = 4000", 'interface = "virtual"')
    parse_rig(scene + joined + joined + 'name = "other"\n', "my.toml", "my")
    free = served.replace("4000", "0")
    parse_rig(scene + free + free + 'name = "other"\n', "my.toml", "my")


def test_an_infinite_corner_switches_the_low_pass_off():
    rig = parse_rig(GOOD.replace("threshold_on = 0.2", "corner_hz_at_reference = inf"), "my.toml", "my")
    assert rig.camera.sensor.corner_hz_at_reference == float("inf")


@pytest.mark.parametrize("key", ["square_px", "threshold_on", "event_ns", "seconds", "tolerance_us", "start_delay_ms"])
def test_what_is_not_a_number_is_refused(key):
    tables = {"square_px": "scene", "threshold_on": "camera.sensor", "event_ns": "camera.sensor.readout"}
    table = tables.get(key, "camera" if key == "start_delay_ms" else "run")
    scene = "" if table == "scene" else '[scene]\nkind = "checkerboard"\n'
    kind = 'kind = "checkerboard"\n' if table == "scene" else ""
    assert key in message(f"{scene}[{table}]\n{kind}{key} = nan\n")


def test_rigs_are_found_by_path_or_name(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(GOOD)
    assert load_rig(str(path)).name == "own"
    assert find_rig("eros") == shipped_rigs()["eros"]
    with pytest.raises(RigError, match="did you mean 'eros'"):
        find_rig("erso")
    with pytest.raises(RigError, match="no such file"):
        find_rig(str(tmp_path / "none.toml"))


def test_a_shape_is_looked_for_beside_the_rig(tmp_path):
    (tmp_path / "rock.tab").write_text("v 0 0 0\n")
    path = tmp_path / "rock.toml"
    path.write_text('[scene]\nkind = "bodies"\n[[scene.bodies]]\nshape = "rock.tab"\n')
    assert load_rig(str(path)).scene.bodies[0].shape == str(tmp_path / "rock.tab")


def test_the_schema_knows_every_key():
    schema = json.loads(json.dumps(rig_schema()))
    for kind in (*SCENES.values(), *LINKS.values()):
        parameters = kind.parameters
        known = schema["$defs"][parameters.__name__]["properties"]
        assert {f.name for f in dataclasses.fields(parameters)} | {"kind"} == set(known)
    assert "required" not in schema["$defs"]["SensorParameters"]


CAN = '[scene]\nkind = "checkerboard"\n[[links]]\nkind = "can"\n'


def test_the_identifiers_of_a_can_link_follow_its_node():
    (link,) = parse_rig(f"{CAN}node = 5\n[links.identifiers]\nevents = 0x123\n", "r.toml", "r").links
    assert (link.identifiers.heartbeat, link.identifiers.events, link.identifiers.sync) == (0x705, 0x123, 0x080)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("[links.identifiers]\nepoch = 0x1A2\n", r"line 6.*epoch and events have the same identifier 0x1a2"),
        ("node = 200\n", "line 5.*node must be 1 to 127"),
        ('interface = "socketcan"\nfd = true\ncarriage = "cfp"\n', "line 6.*classic frames only"),
        ("[links.instrument]\nregion = [300, 0, 100, 10]\n", "line 6.*reaches beyond the 346x260 pixels"),
        ("share = 2.0\n", "line 5.*share must be"),
    ],
)
def test_mistakes_in_a_can_link_are_told_by_line(more, told):
    with pytest.raises(RigError, match=told):
        parse_rig(CAN + more, "r.toml", "r")


def test_an_evk4_takes_hexadecimal_serials_alone():
    rig = '[scene]\nkind = "checkerboard"\n[camera]\nmodel = "evk4"\nserial = "{}"\n[[links]]\nkind = "usbip"\n'
    assert parse_rig(rig.format("c0ffee"), "r.toml", "r").camera.size == (1280, 720)
    with pytest.raises(RigError, match=r"line 5.*camera\.serial.*hexadecimal"):
        parse_rig(rig.format("coffee"), "r.toml", "r")


def test_raw_frames_refuse_a_sensor_that_is_too_large():
    camera = '[camera]\nmodel = "davis346"\n[camera.sensor]\nwidth = 640\nheight = 480\n'
    with pytest.raises(RigError, match=r"raw frames number 512 columns and rows, not 640x480"):
        parse_rig(camera + CAN, "r.toml", "r")


IMX636 = """\
title = "t"
[scene]
kind = "checkerboard"
[camera]
model = "{model}"
[camera.bias_slopes]
{slopes}
[camera.sensor]
source_follower_hz = {follower_hz}
"""


@pytest.mark.parametrize("model", ["evk4", "triton2", "imx636"])
@pytest.mark.parametrize(("follower_hz", "low_pass"), [(0.0, "corner_max_hz"), (500.0, "source_follower_hz")])
def test_a_rig_gives_the_slopes_of_biases(model, follower_hz, low_pass):
    text = IMX636.format(model=model, slopes="diff_on = 0.01", follower_hz=follower_hz)
    biases = parse_rig(text, "t.toml", "t").camera.bias_model
    assert biases.factors({"diff_on": 10, "fo": 10}) == {
        "threshold_on": pytest.approx(math.exp(0.1)),
        low_pass: pytest.approx(1.12),
    }


def test_slopes_of_biases_are_refused_where_there_are_none_or_they_cannot_be():
    for model in ("davis346", "dvxplorer_micro"):
        text = IMX636.format(model=model, slopes="", follower_hz=0.0)
        assert f"biases of a {model} have no slopes" in message(text)
    assert "refr must be 0 to 1" in message(IMX636.format(model="evk4", slopes="refr = 2.0", follower_hz=0.0))


def test_a_genx320_has_slopes_of_its_own_beside_those_of_the_rig():
    biases = parse_rig(IMX636.format(model="genx320", slopes="diff_on = 0.01", follower_hz=0.0), "t.toml", "t").camera
    assert biases.bias_model.slopes == dataclasses.replace(SLOPES, diff_on=0.01)
    assert parse_rig(GOOD.replace('"davis346"', '"genx320"'), "t.toml", "t").camera.bias_model.slopes == SLOPES


@pytest.mark.parametrize(("model", "size", "pitch_um"), [("gen31", (640, 480), 15.0), ("genx320", (320, 320), 6.3)])
def test_other_chips_of_prophesee_are_camera_models(model, size, pitch_um):
    text = GOOD.replace('kind = "usbip"\nport = 0\n[[links]]\n', "").replace('"davis346"', f'"{model}"')
    camera = parse_rig(text, "my.toml", "my").camera
    assert camera.size == size
    assert camera.sensor.background == PRESETS[model].background
    assert CAMERA_MODELS[model].chip.pitch_um == pitch_um
