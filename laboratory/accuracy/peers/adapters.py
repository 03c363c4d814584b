"""Adapters of simulators to the worker: v2e, ESIM, OpenEB, IEBCS, DVS-Voltmeter, evlib, eventcv, Neurosim, and ours.

Each is a class for `worker.py`, by the name that `evstim accuracy peers --simulator NAME=PATH` takes, with everything
but the thresholds turned off, except where `settings.whole` is set: then, for its cost, a simulator has what the text
`whole` of its class lists. PATH is the simulator's checkout, that of ESIM with the module `esim_py` compiled in its
folder of that name; for evlib, eventcv and Neurosim's kernel, which are installed as packages, it may be left out. This
file imports evstim only in our own adapters: the others need numpy, the simulator, and what that needs.

ESIM and IEBCS are under the GPL: they run in a process of their own, from the user's copy, and nothing of them is here.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import subprocess
import sys
import tempfile
import types
from pathlib import Path
from typing import Any

import numpy as np

Events = tuple[Any, Any, Any, Any]


def checkout(path: str) -> tuple[str, str]:
    """Return the commit of a checkout and its date, or empty strings."""
    command = ["git", "-C", path, "log", "-1", "--format=%h %cs"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    commit, _, date = done.stdout.strip().partition(" ")
    return commit, date


class _Nothing(types.ModuleType):
    """A module that has every name and does nothing."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *a, **k: None, "__call__": lambda self, *a, **k: None})


def stand_in(*names: str) -> None:
    """Put an empty module in place of each that a simulator imports, does not need here, and is not installed."""
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            sys.modules[name] = _Nothing(name)


class v2e:
    """v2e (Hu, Liu and Delbruck, 2021): EventEmulator.generate_events."""

    name, takes = "v2e", "float, 0 to 255, linear below 20"
    notes = "events of a frame are spread by the pixel that has most; times are float32 seconds"
    whole = "low-pass, leak, shot noise, mismatch, refractory period"

    def __init__(self, settings: Any) -> None:
        self.version, self.date = checkout(settings.path)
        sys.path.insert(0, settings.path)
        stand_in("easygui", "screeninfo", "engineering_notation", "dv_processing", "tkinter", "cv2", "h5py", "numba")
        self.emulator = importlib.import_module("v2ecore.emulator").EventEmulator(
            pos_thres=settings.threshold_on, neg_thres=settings.threshold_off, sigma_thres=0.01 * settings.whole,
            cutoff_hz=286 * settings.whole, leak_rate_hz=0.1 * settings.whole, shot_noise_rate_hz=settings.whole,
            refractory_period_s=5e-4 * settings.whole, seed=1, device="cpu", output_width=settings.width,
            output_height=settings.height,
        )  # fmt: skip

    def step(self, frame: Any) -> Events | None:
        """See `worker`."""
        events = self.emulator.generate_events(frame.light * 255.0, frame.t_ns * 1e-9)
        return None if events is None else (events[:, 0] * 1e6, events[:, 1], events[:, 2], events[:, 3])


class esim:
    """ESIM (Rebecq et al., 2018) by the Python binding of vid2e, which reads images from files."""

    name, takes = "ESIM (vid2e)", "8 bits, from PGM files"
    notes = "times include writing and reading an image file for each frame"

    def __init__(self, settings: Any) -> None:
        sys.path[:0] = [str(Path(settings.path) / "esim_py"), settings.path]
        self.version, self.date = checkout(settings.path)
        on, off = settings.threshold_on, settings.threshold_off
        self.simulator = importlib.import_module("esim_py").EventSimulator(on, off, 0.0, 1e-6, True)
        self.folder = tempfile.TemporaryDirectory()
        self.files: list[str] = []
        self.t_s: list[float] = []

    def step(self, frame: Any) -> None:
        """See `worker`."""
        grey = np.round(frame.light * 255).astype(np.uint8)
        file = Path(self.folder.name) / f"{len(self.files):06}.pgm"
        file.write_bytes(b"P5 %d %d 255\n" % grey.shape[::-1] + grey.tobytes())
        self.files.append(str(file))
        self.t_s.append(frame.t_ns * 1e-9)

    def finish(self) -> Events:
        """See `worker`."""
        events = self.simulator.generateFromStampedImageSequence(self.files, self.t_s)
        self.folder.cleanup()
        return events[:, 2] * 1e6, events[:, 0], events[:, 1], events[:, 3]


class openeb:
    """OpenEB's EventSimulator (metavision_core_ml), loaded without the rest of Metavision."""

    name, takes = "OpenEB", "float, 0 to 255"
    notes = "times are whole us"
    whole = "low-pass, leak, shot noise, mismatch, refractory period"

    def __init__(self, settings: Any) -> None:
        self.version, self.date = checkout(settings.path)
        package = Path(settings.path) / "sdk/modules/core_ml/python/pypkg"
        sys.path.insert(0, str(package))
        part = sys.modules["metavision_core_ml.video_to_event"] = types.ModuleType("video_to_event")
        part.__path__ = [str(package / "metavision_core_ml/video_to_event")]
        base = sys.modules["metavision_sdk_base"] = types.ModuleType("metavision_sdk_base")
        base.EventCD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])  # type: ignore[attr-defined]
        module = importlib.import_module("metavision_core_ml.video_to_event.simulator")
        on, off = settings.threshold_on, settings.threshold_off
        everything = (500, 0.01, 286, 0.1, 1) if settings.whole else (0,)
        self.simulator = module.EventSimulator(settings.height, settings.width, on, off, *everything)

    def step(self, frame: Any) -> Events:
        """See `worker`."""
        self.simulator.image_callback(frame.light * 255, frame.t_ns / 1000)
        events = self.simulator.get_events()
        self.simulator.event_maker.num = 0  # `flush_events` would fill its whole buffer of 1.4 GB
        return events["t"], events["x"], events["y"], events["p"]


class iebcs:
    """IEBCS (Joubert et al., 2021): DvsSensor.update."""

    name, takes = "IEBCS", "float, 1 is 10 klux"
    notes = (
        "its low-pass stays on, 100 us at 1 klux as in its examples, since its times are solved in that exponential; "
        "after each event the reference is the level then; times are whole us"
    )
    whole = "low-pass, latency, jitter, noise events, threshold noise, refractory period"

    def __init__(self, settings: Any) -> None:
        self.version, self.date = checkout(settings.path)
        sys.path.insert(0, str(Path(settings.path) / "src"))
        stand_in("tqdm", "cv2")
        self.sensor = importlib.import_module("dvs_sensor").DvsSensor("sensor")
        # Latency, jitter, refractory period and low-pass, us; thresholds and their noise; noise events, Hz.
        us, noise, on_hz, off_hz = (
            ((100, 30, 50, 100), 0.02, 0.1, 0.01) if settings.whole else ((0, 0, 0, 100), 0, 1e-9, 1e-9)
        )
        thresholds = settings.threshold_on, settings.threshold_off
        self.sensor.initCamera(settings.width, settings.height, *us, *thresholds, noise, on_hz, off_hz)
        self.t_us: int | None = None

    def step(self, frame: Any) -> Events | None:
        """See `worker`."""
        lux, t_us, before = frame.light * 1e4, frame.t_ns // 1000, self.t_us
        self.t_us = t_us
        if before is None:
            self.sensor.init_image(lux)
            return None
        events = self.sensor.update(lux, t_us - before)
        return events.get_ts(), events.get_x(), events.get_y(), events.get_p()


class dvs_voltmeter:
    """DVS-Voltmeter (Lin et al., 2022): EventSim.generate_events."""

    name, takes = "DVS-Voltmeter", "float, 0 to 255"
    notes = "its noise cannot be 0 and is 1e-9; both thresholds are one number; times are whole us"
    whole = "its constants of a DVS346: drift and noise"

    def __init__(self, settings: Any) -> None:
        self.version, self.date = checkout(settings.path)
        sys.path.insert(0, settings.path)
        plain, dvs346 = [1 / settings.threshold_on, 0.0, 0.0, 0.0, 0.0, 1e-9], [5.265, 20, 1e-4, 1e-7, 5e-9, 1e-5]
        sensor = types.SimpleNamespace(K=dvs346 if settings.whole else plain)
        simulator = importlib.import_module("src.simulator")
        self.simulator = simulator.EventSim(types.SimpleNamespace(SENSOR=sensor), "", "")

    def step(self, frame: Any) -> Events | None:
        """See `worker`."""
        events = self.simulator.generate_events(frame.light * 255, frame.t_ns // 1000)
        return None if events is None else tuple(events.T)


class evlib:
    """evlib's ESIMSimulator."""

    name, takes = "evlib", "float, 0 to 255"
    notes = "times are those of the frames"

    def __init__(self, settings: Any) -> None:
        if settings.path:
            sys.path.insert(0, settings.path)
        self.version, self.date = importlib.metadata.version("evlib"), ""
        package = importlib.import_module("evlib.simulation.esim")
        on, off = settings.threshold_on, settings.threshold_off
        configuration = package.ESIMConfig(on, off, refractory_period_ms=0.0, log_floor=1e-6, device="cpu")
        self.simulator = package.ESIMSimulator(configuration)

    def step(self, frame: Any) -> Events:
        """See `worker`."""
        x, y, t, p = self.simulator.process_frame(frame.light * 255.0, frame.t_ns * 1e-9)
        return t * 1e6, x, y, p


class eventcv:
    """eventcv's simulate, which takes all frames at once."""

    name, takes = "eventcv", "8 bits in sRGB, linear below 20 of 255"
    notes = "times are whole us"
    whole = "low-pass, leak, shot noise, mismatch, refractory period, as by default"

    def __init__(self, settings: Any) -> None:
        if settings.path:
            sys.path.insert(0, settings.path)
        self.version = importlib.metadata.version("eventcv")
        self.date = ""
        self.settings = settings
        self.frames: list[Any] = []
        self.simulate = importlib.import_module("eventcv").simulate

    def step(self, frame: Any) -> None:
        """See `worker`."""
        light = frame.light
        display = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)
        self.frames.append(np.round(255 * display).astype(np.uint8))

    def finish(self) -> Events:
        """See `worker`."""
        off = ("sigma_thres", "refractory_us", "cutoff_hz", "leak_rate_hz", "shot_noise_rate_hz")
        events = self.simulate(
            np.stack(self.frames), fps=float(self.settings.images_per_s), pos_thres=self.settings.threshold_on,
            neg_thres=self.settings.threshold_off, **({} if self.settings.whole else dict.fromkeys(off, 0)),
        ).numpy()  # fmt: skip
        return events[:, 2], events[:, 0], events[:, 1], events[:, 3]


class neurosim:
    """The kernel of Neurosim, neurosim_cu_esim, on a CUDA device."""

    name, takes, device = "Neurosim", "float, linear", "gpu"
    notes = "at most one event of a pixel a frame; times are those of the frames"

    def __init__(self, settings: Any) -> None:
        if settings.path:
            sys.path.insert(0, settings.path)
        self.version, self.date = checkout(settings.path) if settings.path else ("", "")
        self.torch = importlib.import_module("torch")
        package = importlib.import_module("neurosim_cu_esim.simulator")
        on, off = settings.threshold_on, settings.threshold_off
        self.simulator = package.EventSimulator(
            settings.width, settings.height, contrast_threshold_neg=off, contrast_threshold_pos=on
        )

    def step(self, frame: Any) -> Events | None:
        """See `worker`."""
        events = self.simulator(self.torch.from_numpy(frame.light).to("cuda"), frame.t_ns // 1000)
        if events is None:
            return None
        t, x, y, on = (part.cpu().numpy() for part in (events.t, events.x, events.y, events.p))
        return t, x, y, on


class _Evstim:
    """Our pixels with everything off; `rate` and `at` are what they get beside the light of the frames."""

    takes, rate, refines = "float, linear", True, False
    notes, whole = "", ""

    def __init__(self, settings: Any) -> None:
        presets = importlib.import_module("emulator.sensor.presets").PRESETS
        parameters = importlib.import_module("dataclasses").replace(
            presets["davis346" if settings.whole else "ideal"], width=settings.width, height=settings.height,
            threshold_on=settings.threshold_on, threshold_off=settings.threshold_off,
            dark_current_relative=1e-3 if settings.whole else 1e-9,
        )  # fmt: skip
        self.frame_type = importlib.import_module("emulator.light").LightFrame
        self.version = importlib.metadata.version("evstim")
        self.date = checkout(str(Path(__file__).parent))[1]
        light = importlib.import_module("laboratory.accuracy.peers.sequences").light_of(settings.scene)
        self.at = importlib.import_module("laboratory.accuracy.harness").pixel_light(light) if self.refines else None
        self.width = settings.width
        self.started = False
        self.sensor = None
        if settings.whole:
            self.sensor = importlib.import_module("emulator.sensor.sensor").Sensor(parameters, 1)
        self.array = self.sensor or importlib.import_module("emulator.sensor.pixels.array").PixelArray(parameters, 1)

    def step(self, frame: Any) -> Events | None:
        """See `worker`."""
        ours = self.frame_type(frame.t_ns, frame.light, frame.rate if self.rate else None, self.at)
        if not self.started:
            self.started = True
            self.array.reset(ours)
            return None
        if self.sensor is not None:
            events = self.sensor.expose(ours)
            return events["t"], events["x"], events["y"], events["on"]
        found = self.array.step(ours)
        return found.t_ns * 1e-3, found.pixel % self.width, found.pixel // self.width, found.on


_SENSOR = "a DAVIS346 with filters, leak, noise, mismatch, refractory period and read-out"


class evstim(_Evstim):
    """Ours with the light and its time derivative, as rigs run by default."""

    name, notes = "evstim", "gets the light's time derivative with each frame, as its own scenes give it"
    whole = _SENSOR


class evstim_line(_Evstim):
    """Ours with frames alone: a straight line in log light between them."""

    name, rate, whole = "evstim, frames alone", False, _SENSOR


class evstim_refined(_Evstim):
    """Ours with the light of single pixels between the frames, for those whose frames are too far apart."""

    name, refines = "evstim, refined", True
    notes = "gets the derivative, and requests the light of single pixels between the frames where it needs it"
