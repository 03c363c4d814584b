"""One landing: starts the camera, the flight computer and the spacecraft; says how it ended.

    python fly.py [--height 300] [--seed 1] [--terrain 8] [--rig landing.toml] [--out DIR]

The seed draws the start (speeds, place), the errors of navigation and engine, the camera's noise. Exit code 0: landed
below 1 m/s. In DIR: truth.csv (the vehicle), computer.jsonl (what the computer saw), summary.json (the camera's run),
verdict.json. With --attach CAN_PORT POSE_PORT SERIAL the camera runs already: so `evstim campaign` uses it.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from errors import divergence_errors
from guidance import Law
from processes import Ends, bus_of, camera, computer
from spacecraft import NoAnswer, Spacecraft, TouchDown
from vehicle import GRAVITY_M_S2, Lander, State

from emulator.rig.loading import load_rig
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import build_ground

_HERE = Path(__file__).parent
_SOFT_M_S = 1.0
_COLUMNS = "t_s,x_m,y_m,z_m,ground_m,vx_m_s,vy_m_s,vz_m_s,thrust_n,mass_kg"

Height = Callable[[float, float], float]


@dataclass(frozen=True)
class Start:
    """How a landing begins, and what navigation takes it for."""

    state: State
    lander: Lander
    known_height_m: float
    known_velocity_m_s: tuple[float, float, float]

    @classmethod
    def drawn(cls, height_m: float, seed: int) -> Start:
        """Return the start of a seed."""
        draw = np.random.default_rng(seed)
        down = Law().wanted_1_s(height_m) * height_m * draw.uniform(0.9, 1.1)
        velocity = np.array([*draw.normal(0, 0.0004 * height_m, 2), -down])
        mass_kg = draw.uniform(900, 1100)
        lander = Lander(thrust_scale=draw.uniform(0.97, 1.03))
        place_m = np.array([*draw.uniform(-5, 5, 2), height_m])  # heights are above the ground at the origin
        state = State(place_m, velocity, mass_kg=mass_kg, thrust_n=mass_kg * GRAVITY_M_S2)
        known = velocity * draw.uniform(0.95, 1.05)
        return cls(state, lander, height_m * draw.uniform(0.9, 1.1), tuple(known.tolist()))

    @property
    def known(self) -> tuple[float, ...]:
        """Height and velocity."""
        return self.known_height_m, *self.known_velocity_m_s


def fly(start: Start, ends: Ends, seed: int, out: Path) -> TouchDown:
    """Return how a landing ended, whose camera runs; its files are in `out`."""
    ground = ground_of(out / "landing.toml")
    with ExitStack() as stack:
        bus = stack.enter_context(bus_of(ends))
        stack.enter_context(computer(ends, start.known, seed, out))
        truth = stack.enter_context((out / "truth.csv").open("w"))
        truth.write(_COLUMNS + "\n")

        def told(t_s: float, state: State) -> None:
            x, y, z = state.position_m.tolist()
            figures = (t_s, x, y, z, ground(x, y), *state.velocity_m_s, state.thrust_n, state.mass_kg)
            print(",".join(f"{one:.6g}" for one in figures), file=truth, flush=True)
            print(f"\r{t_s:6.1f} s  {z:8.1f} m  {state.velocity_m_s[2]:7.2f} m/s", end="")

        spacecraft = Spacecraft(start.lander, start.state, bus, ("127.0.0.1", ends.pose_port))
        return spacecraft.land(ground, told)


def ground_of(rig: Path) -> Height:
    """Return the height of a rig's ground under a place; off its map that of the middle."""
    scene = load_rig(str(rig)).scene
    assert isinstance(scene, TerrainParameters), "landing.toml is a terrain"
    ground = build_ground(scene)
    return lambda x_m, y_m: ground.height_m(x_m, y_m) or 0.0


def verdict(end: TouchDown, out: Path) -> dict[str, float | bool]:
    """Return how a landing ended, and how good its divergence was."""
    told = {"soft": end.touched and end.vertical_m_s < _SOFT_M_S, "touched": end.touched, "t_s": end.t_s}
    told |= {"vertical_m_s": end.vertical_m_s, "horizontal_m_s": end.horizontal_m_s}
    return told | {"fuel_kg": end.fuel_kg} | divergence_errors(out)


def main() -> int:
    """Fly once."""
    arguments = _arguments()
    out = (arguments.out or Path(tempfile.mkdtemp(prefix="landing-"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    ends = Ends.free(out)
    if arguments.attach:
        can_port, pose_port, serial = arguments.attach
        ends = Ends(int(can_port), int(pose_port), serial)
    rig = out / "landing.toml"
    text = re.sub(r"(?m)^seed = 8$", f"seed = {arguments.terrain}", arguments.rig.read_text())
    rig.write_text(ends.rig(text))
    try:
        with ExitStack() as stack:
            if not arguments.attach:
                stack.enter_context(camera(rig, arguments.seed, out, arguments.record))
            end = fly(Start.drawn(arguments.height, arguments.seed), ends, arguments.seed, out)
    except NoAnswer as error:
        print(f"\n{error}", file=sys.stderr)
        return 3
    told = verdict(end, out)
    print(f"\n{'landed' if told['soft'] else 'CRASHED'} after {end.t_s:.1f} s at {end.vertical_m_s:.2f} m/s down, "
          f"{end.horizontal_m_s:.2f} m/s along the ground; files in {out}")  # fmt: skip
    for file in (out / "verdict.json", *([arguments.result] if arguments.result else [])):
        file.write_text(json.dumps(told))
    return 0 if told["soft"] else 1


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=float, default=300.0, help="m")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--terrain", type=int, default=8, help="seed of the ground")
    parser.add_argument("--rig", type=Path, default=_HERE / "landing.toml")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--attach", nargs=3, metavar=("CAN_PORT", "POSE_PORT", "SERIAL"), default=None)
    parser.add_argument("--record", type=Path, default=None, help="keep the events in this .npz")
    parser.add_argument("--result", type=Path, default=None, help="a copy of verdict.json")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
