"""`evstim play`: pictures in a terminal or window at their times, Ctrl-Z, the end by a signal, refused input."""

import fcntl
import json
import os
import pty
import re
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import termios

import numpy as np
import pytest
from PIL import Image

from emulator.cli import picture
from emulator.cli.signals import interrupt_on_stop_signals
from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

pytestmark = pytest.mark.usefixtures("reads_here")

SIZE, ON, OFF, BLACK = (346, 260), (230, 159, 0), (86, 180, 233), (0, 0, 0)
START_US = 7_000_000  # a recording need not begin at zero
EVENTS = np.array(
    [(START_US, 1, 2, True), (START_US + 390_000, 30, 40, True), (START_US + 399_000, 50, 61, False),
     (START_US + 900_000, 345, 259, True)], EVENT,
)  # fmt: skip
RIG = """
[scene]
kind = "checkerboard"
speed_px_s = 200.0
[camera]
model = "ideal"
[camera.sensor]
width = 64
height = 48
[run]
step_us = 2000
"""
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"


class Clock:
    """Clock that a sleep sets to its deadline, and `late_ns` beyond it; `at_sleep` is called with their number."""

    def __init__(self, late_ns=0, at_sleep=lambda _: None):
        self.deadlines_ns, self.late_ns, self.at_sleep, self._now_ns = [], late_ns, at_sleep, 5_000_000_000

    def now_ns(self):
        return self._now_ns

    def sleep_until(self, deadline_ns):
        self.deadlines_ns.append(deadline_ns)
        self._now_ns = max(self._now_ns, deadline_ns) + self.late_ns
        self.at_sleep(len(self.deadlines_ns))


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(picture, "MonotonicClock", lambda: made)
    return made


@pytest.fixture
def terminal(monkeypatch):
    """Make stdout a terminal with one character for two pixels of the recording, and a line below."""

    def made(columns=SIZE[0], lines=SIZE[1] // 2 + 1):
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        monkeypatch.setenv("TERM", "xterm-256color")
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setenv("LINES", str(lines))

    return made


@pytest.fixture
def recording(tmp_path):
    file = RecordingFile(tmp_path / "a.aedat4", FORMATS["aedat4"], Facts(SIZE, streams=frozenset()))
    file.write(Part(EVENTS))
    file.close()
    return tmp_path / "a.aedat4"


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "a.toml").write_text(RIG)
    return tmp_path / "a.toml"


def pictures(out):
    """Each picture as the colours that a terminal shows, (height, width, 3), with the text below it."""
    shown = []
    for frame in out.split("\x1b[H")[1:]:
        rows = []
        *lines, text = frame.split("\x1b[J")[0].split("\n")
        for line in lines:
            colours, upper, lower = [0] * 6, [], []
            for part in re.findall(r"\x1b\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m|(\u2580)", line):
                if part[6]:
                    upper.append(colours[:3])
                    lower.append(colours[3:])
                else:
                    colours = list(map(int, part[:6]))
            rows += [upper, lower]
        shown.append((np.array(rows), text))
    return shown


def test_a_recording_is_shown_pixel_by_pixel(evstim, terminal, clock, recording):
    terminal()
    done = evstim("play", recording, "--speed", "10", "--json")  # a picture has 0.4 s
    assert done.code == 0
    shown = pictures(done.out)
    assert [text for _, text in shown][:2] == [
        "a.aedat4  0.00 s, events of 400 ms",
        "a.aedat4  0.40 s, events of 400 ms",
    ]
    assert {colours.shape for colours, _ in shown} == {(260, 346, 3)}
    second, last = shown[1][0], shown[-1][0]
    assert [tuple(second[y, x]) for x, y in ((1, 2), (30, 40), (50, 61), (0, 0))] == [ON, ON, OFF, BLACK]
    assert np.count_nonzero(second.any(axis=2)) == 3
    assert tuple(last[259, 345]) == ON
    result = json.loads(done.out.splitlines()[-1].rpartition("\x1b[?1049l")[2])
    assert (result["pictures"], result["events"]) == (4, 4)
    assert (result["stream_s"], result["wall_s"]) == (pytest.approx(0.9, abs=1e-5), pytest.approx(0.12))
    assert clock.deadlines_ns == [5_000_000_000 + k * 40_000_000 for k in range(4)]


def test_no_event_is_lost_in_a_small_terminal(evstim, terminal, clock, recording):
    terminal(80, 24)
    shown = pictures(evstim("play", recording, "--speed", "10").out)
    colours = shown[1][0]
    assert colours.shape == (46, 61, 3)
    at = {(x * 61 // 346, y * 45 // 260) for x, y in ((1, 2), (30, 40), (50, 61))}
    assert sum(colours[y, x].any() for x, y in at) >= 2
    assert np.count_nonzero(colours.any(axis=2)) == 3


def test_a_terminal_larger_than_any_screen_gets_a_bounded_picture(evstim, terminal, clock, rig):
    terminal(65535, 65535)
    out = evstim("play", rig, "--seconds", "0.04").out
    assert len(out) < 3 * 20_000_000
    assert out.count("\u2580") == 2 * 480 * 1280


def test_a_name_does_not_reach_the_terminal_as_a_command(evstim, terminal, clock, tmp_path):
    terminal()
    recording = tmp_path / "a\x1b]0;b\x07\n\udc9b2J.raw"  # the last one is a byte that is no UTF-8
    file = RecordingFile(recording, FORMATS["evt3"], Facts(SIZE))
    file.write(Part(EVENTS))
    file.close()
    out = evstim("play", recording, "--speed", "10").out
    assert pictures(out)[0][1] == r"a\x1b]0;b\x07\n\udc9b2J.raw  0.00 s, events of 400 ms"
    assert r"a\x1b]0;b" in out.rpartition(LEAVE)[2]
    assert not re.search(r"\x1b\]|[\x07\udc9b]", out)
    done = evstim("play", recording, "--out", recording.with_name("a.png"))
    assert (done.code, "\x1b" in done.out) == (0, False)


@pytest.mark.parametrize("late_ms", [10, 100])
def test_a_late_picture_delays_those_after_it_and_the_summary_shows_it(late_ms, evstim, terminal, clock, recording):
    terminal()
    clock.late_ns = late_ms * 1_000_000
    out = evstim("play", recording, "--speed", "10").out
    gaps_ms = np.diff(clock.deadlines_ns) / 1e6
    assert gaps_ms == pytest.approx([40] * 3 if late_ms < 40 else [100] * 3)
    assert f"of stream time in {0.13 if late_ms < 40 else 0.40:.2f} s" in out


def test_a_rig_is_shown_as_large_as_it_fits(evstim, terminal, clock, rig):
    terminal(200, 60)
    done = evstim("play", rig, "--seconds", "0.1", "--json")
    assert done.code == 0, done.err
    shown = pictures(done.out)
    assert [colours.shape for colours, _ in shown] == [(96, 128, 3)] * 3
    first = shown[1][0]
    assert len(np.unique(first[:, :, 0])) > 1
    assert (first[::2, ::2] == first[1::2, 1::2]).all()
    assert json.loads(done.out.splitlines()[-1].rpartition("\x1b[?1049l")[2])["events"] > 100


def test_a_picture_may_be_shorter_than_a_step(evstim, terminal, clock, rig):
    terminal(64, 25)
    out = evstim("play", rig, "--at-s", "0.1", "--seconds", "0.01", "--speed", "0.01").out
    assert len(pictures(out)) == 26  # every 0.4 ms, of steps of 2 ms


@pytest.mark.sampled
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("kind", ["recording", "rig"])
def test_a_signal_ends_with_the_terminal_as_it_was_and_a_line(number, kind, request, evstim, terminal, clock):
    terminal()
    clock.at_sleep = lambda count: signal.raise_signal(number) if count == 3 else None
    interrupt_on_stop_signals()
    done = evstim("play", request.getfixturevalue(kind), "--speed", "0.1")
    assert done.code == 0
    assert done.out.startswith(ENTER)
    name = "a.aedat4" if kind == "recording" else "a"
    assert re.fullmatch(rf"{name}: \d+ events in 2 pictures, 0\.00 s of .*\n", done.out.rpartition(LEAVE)[2])
    assert "Traceback" not in done.err


@pytest.mark.parametrize("dumb", [False, True])
def test_without_a_terminal_it_names_the_command_that_writes_files(dumb, evstim, terminal, monkeypatch, recording):
    if dumb:
        terminal()
        monkeypatch.setenv("TERM", "dumb")
    done = evstim("play", recording)
    assert (done.code, done.out) == (2, "")
    assert f"`evstim picture {recording} FILE.gif`" in " ".join(done.err.split())


@pytest.mark.parametrize(("arguments", "message"), [
    (["a.aedat4", "--speed", "0"], "--speed must be between 1e-06 and 1e+06, got 0"),
    (["a.aedat4", "--speed", "nan"], "--speed must be between 1e-06 and 1e+06, got nan"),
    (["a.aedat4", "--speed", "-1"], "--speed must be between"),
    (["a.aedat4", "--fps", "0"], "--fps must be between 1 and 100, got 0"),
    (["a.aedat4", "--at-s", "nan"], "--at-s must be between"),
    (["a.aedat4", "--seconds", "-1"], "--seconds must be between"),
    (["a.aedat4", "--window-ms", "inf"], "--window-ms must be between"),
    (["gone.aedat4"], "gone.aedat4: No such file"),
    (["gone"], "'gone' is not known here"),
    (["empty.npz"], "it holds no events: there is nothing to draw"),
    (["nonsense.raw"], "none of the recordings that are read"),
    (["a.toml", "--out", "a.gif"], "--out: a rig has no end: give --seconds, such as 2"),
    (["a.aedat4", "--out", "a.txt"], "a.txt: the name must end in .png, .gif or .mp4, got '.txt'"),
])  # fmt: skip
def test_wrong_input_is_refused_before_the_terminal_changes(
    arguments, message, evstim, terminal, recording, rig, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "empty.npz", events=EVENTS[:0], resets=np.zeros(0, np.int64), size=SIZE)
    (tmp_path / "nonsense.raw").write_bytes(b"nonsense")
    terminal()
    done = evstim("play", *arguments)
    assert (done.code, done.out) == (2, "")
    assert message in " ".join(done.err.split())


def test_a_file_instead_of_a_terminal_is_that_of_picture(evstim, tmp_path, recording):
    options = ("--speed", "2", "--fps", "10", "--at-s", "0")
    assert evstim("play", recording, "--out", tmp_path / "a.gif", *options).code == 0
    assert evstim("picture", recording, tmp_path / "b.gif", *options, "--seconds", "60").code == 0
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as movie:
        assert (movie.n_frames, movie.info["duration"]) == (6, 100)  # 0.9 s in steps of 0.2 s, and the end


@pytest.mark.system
def test_ctrl_z_gives_the_shell_its_screen_and_cursor_and_fg_takes_them_again(recording):
    play = [sys.executable, "-c", "from emulator.cli import main; main()", "play", recording, "--speed", "0.001"]
    ours, theirs = pty.openpty()
    shell = subprocess.Popen(
        ["bash", "--norc", "--noprofile", "--noediting", "-i"],
        stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"TERM": "xterm-256color"},
        start_new_session=True, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(theirs)
    seen = ""

    def until(text, after):
        nonlocal seen
        while text not in seen[after:]:
            seen += os.read(ours, 65536).decode(errors="replace")
        return len(seen)

    def state():
        """(whether the cursor is shown, whether the screen is the shell's), as the last code of each leaves them."""
        return seen.rfind("\x1b[?25h") > seen.rfind("\x1b[?25l"), seen.rfind("\x1b[?1049l") > seen.rfind("\x1b[?1049h")

    try:
        os.write(ours, shlex.join(map(str, play)).encode() + b"\n")
        at = until("events of 0.04 ms", 0)
        for _ in range(2):
            assert state() == (False, False)
            os.write(ours, b"\x1a")
            at = until("Stopped", at)
            assert state() == (True, True)
            os.write(ours, b"fg\n")
            at = until("\x1b[?1049h", at)
            at = until("events of 0.04 ms", at)
        os.write(ours, b"\x03")
        until("s of stream time in", at)
        assert state() == (True, True)
    finally:
        shell.kill()  # the end of the session hangs up on the player
        shell.wait()
        os.close(ours)


@pytest.fixture(scope="module")
def x_server(tmp_path_factory):
    """Start an X server without a screen; return its name, and the file of its pixels.

    It ends with this process: Tk keeps its connection, and ends the process if the server leaves first.
    """
    if shutil.which("Xvfb") is None:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)("there is no Xvfb: apt-get install xvfb")
    tkinter = pytest.importorskip("tkinter")
    folder, (ours, theirs) = tmp_path_factory.mktemp("x"), os.pipe()
    options = ["-displayfd", str(theirs), "-screen", "0", "1024x768x24", "-fbdir", str(folder), "-terminate"]
    in_background = ["sh", "-c", 'Xvfb "$@" >/dev/null 2>&1 &', "sh", *options, "-nolisten", "tcp"]
    subprocess.run(in_background, pass_fds=[theirs], check=True)
    os.close(theirs)
    with os.fdopen(ours) as number:
        name = f":{number.readline().strip()}"
    holder = tkinter.Tk(screenName=name)  # without a client the server would end
    holder.withdraw()
    tkinter._default_root = None
    yield name, folder / "Xvfb_screen0"
    holder.destroy()


@pytest.fixture
def frame_buffer(x_server, monkeypatch):
    """Set the display; return a function that returns its pixels (height, width, 3)."""
    import tkinter

    name, file = x_server
    monkeypatch.setenv("DISPLAY", name)

    def pixels():
        tkinter._default_root.winfo_pointerxy()  # the server answers after it has drawn
        content = file.read_bytes()  # X window dump, XWDFile.h
        head = struct.unpack(">25I", content[:100])
        size, width, height, line, colours = head[0], head[4], head[5], head[12], head[19]
        rows = np.frombuffer(content, np.uint8, line * height, size + 12 * colours).reshape(height, line // 4, 4)
        return rows[:, :width, 2::-1]

    return pixels


@pytest.fixture
def keys():
    """Functions that press a key of the open window, close it, or interrupt the player."""
    import tkinter

    def press(name):
        tkinter._default_root.focus_force()
        tkinter._default_root.event_generate(f"<{name}>")

    return {
        "q": lambda: press("q"),
        "space": lambda: press("space"),
        "close": lambda: tkinter._default_root.tk.call(tkinter._default_root.protocol("WM_DELETE_WINDOW")),
        "signal": lambda: signal.raise_signal(signal.SIGINT),
    }


@pytest.mark.system
def test_a_window_shows_the_pictures_at_their_times(evstim, clock, frame_buffer, recording):
    shown = []
    clock.at_sleep = lambda _: shown.append([np.count_nonzero((frame_buffer() == c).all(axis=2)) for c in (ON, OFF)])
    done = evstim("play", recording, "--window", "--speed", "10", "--json")
    assert (done.code, done.err) == (0, "")
    # Four sleeps of 10 ms before each picture but the first, which needs some of them; a sensor's pixel is 2 x 2 here.
    assert len(shown) == 12
    assert shown[3::4] == [[0, 0], [8, 4], [0, 0]]
    result = json.loads(done.out)
    assert (result["pictures"], result["events"]) == (4, 4)
    assert (result["stream_s"], result["wall_s"]) == (pytest.approx(0.9, abs=1e-5), pytest.approx(0.12))


@pytest.mark.system
def test_the_space_bar_stops_the_stream_until_it_is_pressed_again(evstim, clock, frame_buffer, keys, recording):
    clock.at_sleep = lambda count: keys["space"]() if count in (6, 56) else None
    result = json.loads(evstim("play", recording, "--window", "--speed", "10", "--json").out)
    assert (result["pictures"], result["events"]) == (4, 4)
    assert result["wall_s"] == pytest.approx(
        0.56
    )  # 6 sleeps of 10 ms, 50 in the pause; the last picture is due at once


@pytest.mark.system
@pytest.mark.parametrize("key", ["q", "close", "signal"])
@pytest.mark.parametrize("late_ms", [0, 100])
def test_a_window_ends_with_the_summary_of_the_terminal(late_ms, key, evstim, clock, frame_buffer, keys, recording):
    clock.late_ns = late_ms * 1_000_000
    clock.at_sleep = lambda count: keys[key]() if count == 1 else None
    interrupt_on_stop_signals()
    done = evstim("play", recording, "--window", "--speed", "10")
    assert (done.code, done.err) == (0, "")
    assert re.fullmatch(r"a\.aedat4: 0 events in 1 pictures, 0\.00 s of stream time in 0\.00 s\n", done.out)


@pytest.mark.parametrize(("lacking", "remedy"), [("display", "set DISPLAY"), ("tkinter", "apt-get install python3-tk")])
def test_without_a_display_or_tk_a_window_is_refused_with_the_remedy(lacking, remedy, evstim, monkeypatch, recording):
    monkeypatch.delenv("DISPLAY", raising=False)
    if lacking == "tkinter":
        monkeypatch.setitem(sys.modules, "tkinter", None)
    done = evstim("play", recording, "--window")
    assert (done.code, done.out) == (3, "")
    assert remedy in " ".join(done.err.split())
