"""A spacecraft of Basilisk that finds an asteroid in its camera's images and turns to it. It does not depend on evstim.

Needs `pip install bsk`, in an environment of its own. Basilisk's vizInterface requests images from a visualiser on
`--port`, and waits for them without a limit. After `--patience` seconds this process ends by SIGALRM.
"""

from __future__ import annotations

import argparse
import ctypes
import io
import json
import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.fswAlgorithms import mrpFeedback
from Basilisk.simulation import extForceTorque, planetEphemeris, simpleNav, spacecraft
from Basilisk.utilities import RigidBodyKinematics as rbk
from Basilisk.utilities import SimulationBaseClass, macros, orbitalMotion, simIncludeGravBody, vizSupport
from PIL import Image

WIDTH, HEIGHT = 346, 260
FOCAL_PX = WIDTH / 2 / math.tan(math.radians(21.0) / 2)
WIDE_FOCAL_PX = WIDTH / 2 / math.tan(math.radians(60.0) / 2)
CAMERA = 1
SIGMA_CB = np.array([-0.35, 0.25, 0.1])  # mounting of the camera: an arbitrary attitude
RANGE_M = 200e3
FIRST_ERROR_DEG = np.array([4.0, -3.0])  # to the right and down, of the asteroid in the first image


class Watchdog(sysModel.SysModel):
    """Ends this process when the visualiser does not answer: vizInterface itself has no time limit.

    SIGALRM with its default action ends the process also while compiled code runs. The time begins before the
    first update, and again at each step.
    """

    def __init__(self, limit_s: float) -> None:
        super().__init__()
        self._limit_s = limit_s

    def UpdateState(self, now_ns: int) -> None:
        """Start the time limit again."""
        signal.setitimer(signal.ITIMER_REAL, self._limit_s)


class LightSeeker(sysModel.SysModel):
    """Turns the middle of the light in an image into an attitude error; without light the error is zero."""

    def __init__(self, image_msg: Any, nav_msg: Any) -> None:
        super().__init__()
        self.images = messaging.CameraImageMsgReader()
        self.images.subscribeTo(image_msg)
        self.nav = messaging.NavAttMsgReader()
        self.nav.subscribeTo(nav_msg)
        self.guidance = messaging.AttGuidMsg()
        self.errors_px: list[tuple[float, float]] = []

    def Reset(self, now_ns: int) -> None:
        """Begin with no error."""
        self._write(np.zeros(3), now_ns)

    def UpdateState(self, now_ns: int) -> None:
        """Look at the newest image."""
        image = self.images()
        turn_b = np.zeros(3)
        if image.valid and image.imageBufferLength:
            turn_b = self._turn_to_light(ctypes.string_at(int(image.imagePointer), image.imageBufferLength))
        self._write(turn_b, now_ns)

    def _turn_to_light(self, file: bytes) -> np.ndarray:
        light = np.asarray(Image.open(io.BytesIO(file)).convert("L"), float)
        light[light < 8] = 0
        if not light.any():
            return np.zeros(3)
        rows, columns = np.indices(light.shape)
        x, y = ((light * k).sum() / light.sum() - (n - 1) / 2 for k, n in ((columns, WIDTH), (rows, HEIGHT)))
        self.errors_px.append((float(x), float(y)))
        axis_c = np.array([-y, x, 0.0])  # z, the boresight, crossed with the direction of the light
        turn_c = axis_c / max(np.hypot(x, y), 1e-9) * math.atan(np.hypot(x, y) / FOCAL_PX)
        return rbk.MRP2C(SIGMA_CB).T @ turn_c

    def _write(self, turn_b: np.ndarray, now_ns: int) -> None:
        out = messaging.AttGuidMsgPayload()
        out.sigma_BR = (-turn_b / 4).tolist()  # small angles: an MRP is a quarter of the turn
        out.omega_BR_B = self.nav().omega_BN_B
        self.guidance.write(out, now_ns, self.moduleID)


def build(port: int, period_s: float, image_every: int, cameras: int) -> tuple[Any, ...]:
    """Return the simulation, its spacecraft, Eros's ephemeris, the seeker, and what must not be thrown away."""
    sim = SimulationBaseClass.SimBaseClass()
    process, period_ns = sim.CreateNewProcess("process"), macros.sec2nano(period_s)
    process.addTask(sim.CreateNewTask("task", period_ns))

    eros = planetEphemeris.PlanetEphemeris()
    eros.setPlanetNames(planetEphemeris.StringVector(["eros"]))
    elements = planetEphemeris.ClassicElements()
    elements.a, elements.e, elements.i = 1.458 * orbitalMotion.AU * 1000, 0.2227, math.radians(10.83)
    elements.Omega, elements.omega, elements.f = (math.radians(d) for d in (304.3, 178.9, 40.0))
    eros.planetElements = planetEphemeris.classicElementVector([elements])
    eros.rightAscension = planetEphemeris.DoubleVector([math.radians(11.35)])
    eros.declination = planetEphemeris.DoubleVector([math.radians(17.22)])
    eros.lst0 = planetEphemeris.DoubleVector([math.radians(60.0)])
    eros.rotRate = planetEphemeris.DoubleVector([2 * math.pi / (5.27 * 3600)])
    sim.AddModelToTask("task", eros, 20)

    craft = spacecraft.Spacecraft()
    craft.ModelTag = "seeker"
    inertia = [900.0, 0.0, 0.0, 0.0, 800.0, 0.0, 0.0, 0.0, 600.0]
    craft.hub.mHub = 750.0
    craft.hub.IHubPntBc_B = [inertia[0:3], inertia[3:6], inertia[6:9]]
    gravity = simIncludeGravBody.gravBodyFactory()
    body = gravity.createCustomGravObject("eros", 4.463e5, radEquator=16.8e3)
    body.isCentralBody = True
    body.planetBodyInMsg.subscribeTo(eros.planetOutMsgs[0])
    gravity.addBodiesTo(craft)
    place(craft)
    sim.AddModelToTask("task", craft, 10)

    nav = simpleNav.SimpleNav()
    nav.scStateInMsg.subscribeTo(craft.scStateOutMsg)
    sim.AddModelToTask("task", nav, 9)

    viz = vizSupport.enableUnityVisualization(sim, "task", craft, liveStream=True)
    viz.reqComAddress, viz.reqPortNumber = "127.0.0.1", str(port)
    configs = [camera(viz, number, image_every * period_s) for number in range(CAMERA, CAMERA + cameras)]

    seeker = LightSeeker(viz.opnavImageOutMsgs[0], nav.attOutMsg)
    sim.AddModelToTask("task", seeker, -10)
    control = mrpFeedback.mrpFeedback()
    control.guidInMsg.subscribeTo(seeker.guidance)
    config = messaging.VehicleConfigMsg().write(messaging.VehicleConfigMsgPayload(ISCPntB_B=inertia))
    control.vehConfigInMsg.subscribeTo(config)
    control.K, control.P, control.Ki = 4 * 0.25 * 800.0, 2 * 0.9 * 0.5 * 800.0, -1.0
    sim.AddModelToTask("task", control, -20)
    torque = extForceTorque.ExtForceTorque()
    torque.cmdTorqueInMsg.subscribeTo(control.cmdTorqueOutMsg)
    craft.addDynamicEffector(torque)
    sim.AddModelToTask("task", torque, -30)
    return sim, craft, eros, seeker, (config, gravity, viz, configs, nav, control, torque)


def camera(viz: Any, number: int, image_period_s: float) -> Any:
    """Add a camera and return its configuration; all look the same way, those after the first at a wider angle."""
    focal_px = FOCAL_PX if number == CAMERA else WIDE_FOCAL_PX
    config, message = vizSupport.createCameraConfigMsg(
        viz, cameraID=number, fieldOfView=2 * math.atan(HEIGHT / 2 / focal_px), resolution=[WIDTH, HEIGHT],
        cameraPos_B=[0.2, -0.1, 0.5], sigma_CB=SIGMA_CB.tolist(), renderRate=image_period_s,
    )  # fmt: skip
    config.isOn = 1
    message.write(config)
    return message


def place(craft: Any) -> None:
    """Put the spacecraft before Eros, which is seen off the middle by FIRST_ERROR_DEG."""
    away = np.array([0.45, -0.75, 0.48]) / np.linalg.norm([0.45, -0.75, 0.48])
    craft.hub.r_CN_NInit = (RANGE_M * away).tolist()
    craft.hub.v_CN_NInit = [1.5, 2.0, -1.0]
    x = np.cross([0.0, 0.0, 1.0], away)
    x /= np.linalg.norm(x)
    camera_from_n = np.array([x, np.cross(-away, x), -away])  # looks at Eros
    right, down = np.radians(FIRST_ERROR_DEG)
    off = rbk.PRV2C(np.array([down, -right, 0.0]))
    craft.hub.sigma_BNInit = rbk.C2MRP(rbk.MRP2C(SIGMA_CB).T @ off @ camera_from_n).tolist()
    craft.hub.omega_BN_BInit = [0.0, 0.0, 0.0]


def boresight_error_px(craft: Any, eros: Any) -> tuple[float, float]:
    """Return the position of Eros's middle in the image, from the true states."""
    state, planet = craft.scStateOutMsg.read(), eros.planetOutMsgs[0].read()
    camera_from_n = rbk.MRP2C(SIGMA_CB) @ rbk.MRP2C(np.array(state.sigma_BN))
    x, y, z = camera_from_n @ (np.array(planet.PositionVector) - np.array(state.r_BN_N))
    return float(FOCAL_PX * x / z), float(FOCAL_PX * y / z)


def main() -> None:
    """Run, and write the results of the simulation."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, default=5556)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--period", type=float, default=0.04)
    parser.add_argument("--image-every", type=int, default=1, help="steps from one image to the next")
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--patience", type=float, default=60.0, help="seconds to wait for an answer of the visualiser")
    parser.add_argument("--out", type=Path, default=Path("simulation.json"))
    asked = parser.parse_args()
    sim, craft, eros, seeker, kept = build(asked.port, asked.period, asked.image_every, asked.cameras)
    states = craft.scStateOutMsg.recorder()
    sim.AddModelToTask("task", states, -40)
    watchdog = Watchdog(asked.patience)
    sim.AddModelToTask("task", watchdog, -50)
    watchdog.UpdateState(0)
    sim.InitializeSimulation()
    sim.TotalSim.SingleStepProcesses()
    first = boresight_error_px(craft, eros)
    sim.ConfigureStopTime(macros.sec2nano(asked.seconds))
    sim.ExecuteSimulation()
    known = {
        "nanoseconds": int(sim.TotalSim.CurrentNanos),
        "images": len(seeker.errors_px),
        "true_px": {"first": first, "last": boresight_error_px(craft, eros)},
        "light_px": {"first": seeker.errors_px[:1], "last": seeker.errors_px[-1:]},
        "last_state": {"r_BN_N": states.r_BN_N[-1].tolist(), "sigma_BN": states.sigma_BN[-1].tolist()},
    }
    asked.out.write_text(json.dumps(known, indent=1) + "\n")
    (x0, y0), (x1, y1) = known["true_px"].values()
    print(f"{known['images']} images; Eros from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) pixels off the middle")
    signal.setitimer(signal.ITIMER_REAL, 0)
    del kept, watchdog
    os._exit(0)  # without waiting for the visualiser's socket


if __name__ == "__main__":
    main()
