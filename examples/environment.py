"""A Gymnasium environment: turn a spacecraft so that an asteroid stays in the middle of an event camera.

    python examples/environment.py    # pip install gymnasium; a law of one line against no law

An observation is the number of events in cells of 26 x 20 pixels, OFF and ON. An action is a change of attitude about
the camera's axes down and right, in units of a fifth of a degree. The reward falls with the angle to the asteroid.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

import evstim

STEP_US, CELLS = 40_000, 13
TURN_RAD, LOST_RAD = np.radians(0.2), np.radians(8.0)


class Pointing(gymnasium.Env[np.ndarray, np.ndarray]):
    """Observations (2, 13, 13) float32, actions (2,) float32 from -1 to 1."""

    observation_space = gymnasium.spaces.Box(0, 1e6, (2, CELLS, CELLS), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a run with a pointing error of up to three degrees; the same one for the same seed."""
        super().reset(seed=seed)
        self.close()
        self._sim = evstim.Simulation("eros", seed=int(self.np_random.integers(1 << 31)))
        self._angles = self.np_random.uniform(-0.05, 0.05, 2)
        return self._observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Turn, and return what the camera saw meanwhile."""
        self._angles = self._angles + TURN_RAD * action
        error_rad = float(np.hypot(*self._angles))
        return self._observed(), -error_rad, error_rad > LOST_RAD, False, {"t_us": self._sim.t_us}

    def close(self) -> None:
        """End the run."""
        if hasattr(self, "_sim"):
            self._sim.close()

    def _observed(self) -> np.ndarray:
        about_y, about_x = self._angles / 2
        attitude = np.array([1.0, about_x, about_y, 0.0])
        pose = evstim.Pose(np.array([0.0, 0.0, -100_000.0]), attitude / np.linalg.norm(attitude))
        events = self._sim.step(STEP_US, camera=pose).events
        places = np.column_stack([events["on"], events["y"], events["x"]])
        return np.histogramdd(places, (2, CELLS, CELLS), ((0, 2), (0, 260), (0, 338)))[0].astype(np.float32)


def middle_of_events(counts: np.ndarray) -> np.ndarray:
    """Return the action that turns towards the mean cell of the events."""
    cells = counts.sum(axis=0)
    if not cells.any():
        return np.zeros(2, np.float32)
    right, down = (np.average(np.arange(CELLS) - CELLS // 2, weights=cells.sum(axis=axis)) for axis in (0, 1))
    return np.clip(np.array([right, -down]), -1, 1).astype(np.float32)


def flown(law: Any, steps: int = 20, seed: int = 1) -> float:
    """Return the sum of the rewards of a run."""
    environment, total = Pointing(), 0.0
    counts, _ = environment.reset(seed=seed)
    for _ in range(steps):
        counts, reward, lost, _, _ = environment.step(law(counts))
        total += reward
        if lost:
            break
    environment.close()
    return total


if __name__ == "__main__":
    print(f"no law: {flown(lambda counts: np.zeros(2, np.float32)):.3f}")
    print(f"middle of the events: {flown(middle_of_events):.3f}")
