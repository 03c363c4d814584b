"""Worker that runs a simulator over a folder of frame sequences and writes its events.

This file needs Python and numpy alone and imports nothing of evstim: it runs under the interpreter that has the
simulator, as `evstim accuracy peers` starts it or by hand:

    python worker.py FOLDER EVENTS ADAPTER.py:MAKE [PATH] [SEQUENCE ...]

FOLDER is one that `evstim accuracy export` wrote, EVENTS the folder to write into. MAKE is a function or class of the
adapter file; it is called once for each sequence with its `Settings` and returns a simulator:

    step(frame)     Take the next `Frame`; return the new events as (t_us, x, y, on), (n,) each, or None.
    finish()        Optional: return the events that are left, in the same form. A simulator that takes a whole film at
                    once returns all events here.
    name, version, date, takes, notes, device, whole
                    Optional strings for the table: `takes` is the form of light that it gets, `notes` the remarks, and
                    "gpu" as `device` makes the clock on the wall count and not the time of processors. `whole` lists
                    what it turns on where `settings.whole` is set; without that text such sequences are left out.

Times are in us since the first frame and may have fractions. `on` is True or above 0 for ON events. The first frame
sets the pixels' references.

The worker writes JSON lines to standard output, and what the simulator prints goes to standard error:

    {"about": {...}}                        from the first simulator made
    {"begins": NAME}, {"ends": NAME}        around a sequence
    {"fails": NAME, "reason": TEXT}         in place of the end, if the simulator raised an error or its events are none
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol

import numpy as np

ABOUT = ("name", "version", "date", "takes", "notes", "device", "whole")
"""Attributes of a simulator that are shown in the table."""

MOST_EVENTS = 20_000_000
"""Events of a sequence beyond which a simulator is stopped."""


@dataclass(frozen=True)
class Settings:
    """The sensor and the sequence, for the start of a simulator.

    Attributes
    ----------
    width, height : pixels.
    threshold_on, threshold_off : contrast thresholds, ln units. Everything else of the sensor is off: mismatch, noise,
        leak, refractory period and low-pass.
    scene : name of the light.
    images_per_s : rate of the frames.
    frames : number of the frames.
    whole : True: turn on all that the simulator models, as for a real camera. For times alone: nothing is scored.
    path : place of the simulator's checkout or package as the user gave it, or "".
    """

    width: int
    height: int
    threshold_on: float
    threshold_off: float
    scene: str
    images_per_s: float
    frames: int
    whole: bool = False
    path: str = ""


class Frame(NamedTuple):
    """Light at an instant.

    Attributes
    ----------
    t_ns : time since the first frame, ns.
    light : (height, width) float32, linear light, above 0 and at most 1.
    rate : (height, width) float32, its time derivative, a second, for simulators that can use it.
    """

    t_ns: int
    light: Any
    rate: Any


class Simulator(Protocol):
    """A simulator under its adapter; see the module."""

    def step(self, frame: Frame) -> tuple[Any, Any, Any, Any] | None:
        """Take a frame; return the new events (t_us, x, y, on), (n,) each, or None."""


def load_adapter(place: str) -> Callable[[Settings], Simulator]:
    """Return the function or class `NAME` of the file in `FILE.py:NAME`.

    Raises ValueError where the text has another form, there is no such file, or the file has no such name.
    """
    file, colon, name = place.rpartition(":")
    if not colon or not name.isidentifier():
        raise ValueError(f"{place}: must be FILE.py:NAME, with the name of a function or class in the file")
    if not Path(file).is_file():
        raise ValueError(f"{file}: there is no such file")
    spec = importlib.util.spec_from_file_location("adapter", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file}: must be a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules["adapter"] = module
    spec.loader.exec_module(module)
    made: Callable[[Settings], Simulator] | None = getattr(module, name, None)
    if made is None:
        raise ValueError(f"{file} has no {name}")
    return made


def frames_of(file: Path) -> Iterator[Frame]:
    """Yield the frames of a sequence's file."""
    with np.load(file) as stored:
        t_ns, light, rate = stored["t_ns"], stored["light"], stored["rate"]
    for k in range(t_ns.size):
        yield Frame(int(t_ns[k]), light[k], rate[k])


def run_sequence(simulator: Simulator, frames: Iterator[Frame]) -> dict[str, Any]:
    """Run a simulator over frames; return its events and times.

    Returns
    -------
    dict
        `t_us` float64, `x`, `y` int64, `on` bool and `frame` int64 (the frame with which an event came), (n,) each;
        `wall_ns`, `cpu_ns` int64, the clock and the time of all processors that each frame took, (frames,), the finish
        shared among all.

    Raises
    ------
    ValueError
        Events are not four arrays of one length, or have times or pixels that are not finite.
    OverflowError
        There are more than MOST_EVENTS.
    """
    found: list[tuple[Any, ...]] = []
    wall = []
    cpu = []
    events = 0
    k = -1
    for k, frame in enumerate(frames):
        clocks = time.perf_counter_ns(), time.process_time_ns()
        given = simulator.step(frame)
        cpu.append(time.process_time_ns() - clocks[1])
        wall.append(time.perf_counter_ns() - clocks[0])
        events += _take(given, k, found)
        if events > MOST_EVENTS:
            raise OverflowError(f"more than {MOST_EVENTS} events")
    finish = getattr(simulator, "finish", None)
    if finish is not None:
        clocks = time.perf_counter_ns(), time.process_time_ns()
        given = finish()
        share = (time.process_time_ns() - clocks[1]) // (k + 1), (time.perf_counter_ns() - clocks[0]) // (k + 1)
        cpu, wall = [one + share[0] for one in cpu], [one + share[1] for one in wall]
        _take(given, k + 1, found)
    types = {"t_us": np.float64, "x": np.int64, "y": np.int64, "on": np.bool_, "frame": np.int64}
    columns = zip(*found) if found else [[np.empty(0)]] * len(types)  # noqa: B905 - older Python has no `strict`
    arrays: dict[str, Any] = {name: np.concatenate(part).astype(types[name]) for name, part in zip(types, columns)}  # noqa: B905
    return dict(arrays, wall_ns=np.array(wall, np.int64), cpu_ns=np.array(cpu, np.int64))


def _take(given: Any, k: int, found: list[tuple[Any, ...]]) -> int:
    """Append a copy of the events that came with frame k; return their number."""
    if given is None or len(given) == 0 or np.size(given[0]) == 0:
        return 0
    if len(given) != 4:
        raise ValueError(f"{len(given)} arrays of events: must be t_us, x, y and on")
    t, x, y, on = (np.array(part) for part in given)
    if not t.ndim == x.ndim == y.ndim == on.ndim == 1 or not t.size == x.size == y.size == on.size:
        raise ValueError(f"events of shapes {t.shape}, {x.shape}, {y.shape}, {on.shape}: must be of one length")
    if not (np.isfinite(t).all() and np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("times or pixels of events are not finite")
    found.append((t, x, y, on > 0, np.full(t.size, k)))
    return int(t.size)


def main(arguments: list[str], messages: IO[str]) -> int:
    """Run all sequences, or those that are named; return the exit code."""
    folder, out, adapter, path = Path(arguments[0]), Path(arguments[1]), arguments[2], (*arguments[3:4], "")[0]
    description = json.loads((folder / "sequences.json").read_text())
    sensor = {name: description[name] for name in ("threshold_on", "threshold_off")}
    chosen = arguments[4:] or list(description["sequences"])

    def send(**message: Any) -> None:
        messages.write(json.dumps(message) + "\n")
        messages.flush()

    make = load_adapter(adapter)
    sent = False
    for name in chosen:
        settings = Settings(path=path, **sensor, **description["sequences"][name])
        send(begins=name)
        try:
            simulator = make(settings)
            if not sent:
                send(about={key: str(getattr(simulator, key, "")) for key in ABOUT})
                sent = True
            if settings.whole and not getattr(simulator, "whole", ""):
                send(ends=name)
                continue
            events = run_sequence(simulator, frames_of(folder / f"{name}.npz"))
        except Exception as error:  # noqa: BLE001 - whatever another program raises must not end the run
            send(fails=name, reason=f"{type(error).__name__}: {error}"[:500])
            continue
        np.savez(out / f"{name}.npz", **events)
        send(ends=name)
    return 0


if __name__ == "__main__":
    # Descriptor 1 goes to standard error, also for compiled code that prints.
    sys.path.pop(0)  # this file's folder, whose modules are not meant for the simulator
    original = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with original:
        code = main(sys.argv[1:], original)
        original.flush()
        os._exit(code)  # some simulators hang or crash in their clean-up
