"""A small network that learns optical flow from events: data made here, training, and a test on sequences left out.

    pip install '.[campaign,files,validate]'     # in the source folder of evstim; validate: scikit-learn
    python learn_flow.py                         # 96 sequences of an asteroid that turns; some minutes
    python learn_flow.py --sequences 16          # a first try
    python learn_flow.py --recording mine.aedat4 # the flow in a recording of yours, as arrows: flow.png

Each sample is a patch of the events of 50 ms around one of them, as a voxel grid; its answer is the true flow there.
Sequences that were not trained on are the test: another pole, another speed and another side of the asteroid. Each
sample is turned by 90, 180 and 270 degrees too, since flow has no up. The network knows patches only, so it meets the
aperture problem like any local method; a better one sees the whole picture.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from sklearn.neural_network import MLPRegressor

import evstim

RIG, SIZE = "itokawa", (128, 96)
SECONDS, RATE_HZ = 0.15, 20.0
HALF_PX, BINS = 7, 5
PATCHES = 200  # of a window of events
LEAST_EVENTS = 25  # in a patch
KEYS = {
    "scene.bodies[0].path.pole[0]": ("uniform", -1.0, 1.0),
    "scene.bodies[0].path.pole[1]": ("uniform", -1.0, 1.0),
    "scene.bodies[0].path.pole[2]": ("uniform", -1.0, 1.0),
    "scene.bodies[0].path.start_deg": ("uniform", 0.0, 360.0),
    "scene.bodies[0].path.spin_deg_s": ("log-uniform", 0.1, 0.4),  # flow of up to 200 px/s
}
VARY = {
    "set": {"run": {"step_us": 12500}, "camera": {"sensor": {"width": SIZE[0], "height": SIZE[1]}}},
    "parameters": [{"key": key, "kind": kind, "low": low, "high": high} for key, (kind, low, high) in KEYS.items()],
}


class Samples(NamedTuple):
    """Patches and the true flow at their centres."""

    patches: np.ndarray  # (n, BINS * side * side) float32
    flow_px_s: np.ndarray  # (n, 2)


def patches_at(events: np.ndarray, size: tuple[int, int], x: np.ndarray, y: np.ndarray, until_us: int) -> np.ndarray:
    """Return voxel grids around the pixels (x, y) of the events of 50 ms before a time, (n, BINS * side * side)."""
    begin_us = until_us - round(1e6 / RATE_HZ)
    grid = evstim.representations.voxel_grid(events, size, BINS, begin_us=begin_us, end_us=until_us)
    around = np.pad(grid, ((0, 0), (HALF_PX, HALF_PX), (HALF_PX, HALF_PX)))
    windows = np.lib.stride_tricks.sliding_window_view(around, (2 * HALF_PX + 1, 2 * HALF_PX + 1), axis=(1, 2))
    return np.clip(windows[:, y, x], -3, 3).transpose(1, 0, 2, 3).reshape(len(x), -1)


def chosen(events: np.ndarray, until_us: int, number: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (x, y) of some events of the 50 ms before a time."""
    recent = events[(events["t"] >= until_us - round(1e6 / RATE_HZ)) & (events["t"] < until_us)]
    recent = recent[number.permutation(len(recent))[:PATCHES]]
    return recent["x"].astype(int), recent["y"].astype(int)


def samples_of(sequence: evstim.TruthSequence, number: np.random.Generator) -> Samples:
    """Return samples of the windows of events that end at each true flow but the first."""
    patches, flows = [], []
    times, truth = sequence.arrays["pictures/t"], sequence.arrays["pictures/flow"]
    for t_us, flow in zip(np.rint(times[1:]).astype(int).tolist(), truth[1:], strict=True):
        x, y = chosen(sequence.events, t_us, number)
        patch, answer = patches_at(sequence.events, SIZE, x, y, t_us), flow[y, x]
        on_body = np.isfinite(answer).all(axis=1) & answer.any(axis=1)
        good = on_body & (np.count_nonzero(patch, axis=1) >= LEAST_EVENTS)
        patches.append(patch[good])
        flows.append(answer[good])
    return Samples(np.concatenate(patches), np.concatenate(flows))


def errors_px_s(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the length of each difference, px/s."""
    return np.hypot(*(found - truth).T)


def turned(samples: Samples) -> Samples:
    """Return the samples, and those turned by 90, 180 and 270 degrees."""
    grids = samples.patches.reshape(-1, BINS, 2 * HALF_PX + 1, 2 * HALF_PX + 1)
    patches, flows = [samples.patches], [samples.flow_px_s]
    for quarters in (1, 2, 3):
        patches.append(np.rot90(grids, quarters, axes=(2, 3)).reshape(len(grids), -1))
        flows.append(np.stack([flows[-1][:, 1], -flows[-1][:, 0]], axis=1))
    return Samples(np.concatenate(patches), np.concatenate(flows))


def draw_recording(file: Path, network: MLPRegressor, scale_px_s: float) -> None:
    """Write flow.png: the flow that the network finds in the middle of a recording."""
    import matplotlib.pyplot as plt

    events = evstim.read_events(file)
    if not len(events):
        raise SystemExit(f"{file}: holds no events")
    size = int(events["x"].max()) + 1, int(events["y"].max()) + 1
    until_us = int(events["t"][len(events) // 2]) + 1
    x, y = chosen(events, until_us, np.random.default_rng(1))
    flow = network.predict(patches_at(events, size, x, y, until_us)) * scale_px_s
    plt.quiver(x, y, *flow.T, angles="xy")
    plt.gca().set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", title=f"{file.name}, px/s")
    plt.savefig("flow.png")


def main(*words: str) -> dict[str, float]:
    """Train and test; return median errors on the test sequences: of the network, of no flow, of the mean flow."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=96)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--recording", type=Path, help="in any format that evstim reads")
    arguments = parser.parse_args(words)
    number = np.random.default_rng(arguments.seed)
    data = evstim.dataset(
        RIG, arguments.sequences, seconds=SECONDS, truth=["flow"], rate_hz=RATE_HZ, vary=VARY, seed=arguments.seed
    )
    made = []
    for k in range(len(data)):
        made.append(samples_of(data[k], number))
        print(f"\rsequence {k + 1} of {len(data)}", end="", flush=True)
    print()
    parts = [made[len(made) // 4 :], made[: len(made) // 4]]  # train on three quarters, test on the rest
    train, test = (Samples(*(np.concatenate(arrays) for arrays in zip(*part, strict=True))) for part in parts)
    train = turned(train)
    scale_px_s = float(train.flow_px_s.std())
    network = MLPRegressor(
        hidden_layer_sizes=(128, 64), early_stopping=True, n_iter_no_change=4, random_state=arguments.seed
    )
    network.fit(train.patches, train.flow_px_s / scale_px_s)
    guesses = {
        "network": network.predict(test.patches) * scale_px_s,
        "no flow": np.zeros_like(test.flow_px_s),
        "mean flow": np.broadcast_to(train.flow_px_s.mean(axis=0), test.flow_px_s.shape),
    }
    medians = {name: float(np.median(errors_px_s(guess, test.flow_px_s))) for name, guess in guesses.items()}
    print(f"{len(train.patches)} patches for training, {len(test.patches)} from other sequences for the test")
    for name, median in medians.items():
        print(f"{name}: median error {median:.1f} px/s")
    if arguments.recording is not None:
        draw_recording(arguments.recording, network, scale_px_s)
    return medians


if __name__ == "__main__":
    import sys

    main(*sys.argv[1:])
