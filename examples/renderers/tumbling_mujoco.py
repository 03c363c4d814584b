"""MuJoCo as the renderer of an emulated camera: a satellite that tumbles without gravity, 6 m in front of it.

    pip install "mujoco>=3.2,<4" numpy          evstim itself is needed for one file, evstim/renderer.py
    evstim run tumbling.toml                    in one terminal
    python tumbling_mujoco.py                   in another one; without a display: MUJOCO_GL=egl

MuJoCo gives light with 8 bits, depth, and the body of each pixel. Motion follows from these: a point at depth z on a
body with the velocities v and w moves at v + w x r, and its pixel at f (vx - x vz / z) / z.
"""

from __future__ import annotations

import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np

from evstim.renderer import Camera, Image, Images, Renderer

DISTANCE_M = 6.0
MODEL = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <quality offsamples="8" shadowsize="1024"/>
    <headlight ambient=".02 .02 .02" diffuse="0 0 0" specular="0 0 0"/>
    <map znear="0.01"/>
  </visual>
  <worldbody>
    <light directional="true" dir="-1 1 -1" pos="5 -5 5" diffuse="1 1 1" specular="0 0 0"/>
    <body name="satellite">
      <freejoint/>
      <geom type="box" size=".5 .4 .6" rgba=".8 .8 .75 1"/>
      <geom type="box" size=".7 .02 .35" pos="1.25 0 0" rgba=".2 .2 .3 1"/>
      <geom type="box" size=".7 .02 .35" pos="-1.25 0 0" rgba=".2 .2 .3 1"/>
      <geom type="cylinder" size=".3 .05" pos="0 0 .7" rgba=".9 .9 .9 1"/>
      <geom type="box" size=".15 .01 .1" pos=".2 -.41 .2" rgba=".05 .05 .05 1"/>
      <geom type="box" size=".1 .01 .2" pos="-.25 -.41 -.2" rgba=".9 .4 .1 1"/>
    </body>
    <camera name="evstim" fovy="{field}" pos="0 -{distance} 0" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
</mujoco>
"""


class Tumbling:
    """The satellite, drawn for a camera of evstim's."""

    def __init__(self, camera: Camera) -> None:
        text = MODEL.format(
            width=camera.width, height=camera.height, field=camera.vertical_field_deg, distance=DISTANCE_M
        )
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, camera.height, camera.width)
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        self.x, self.y = (columns - camera.width / 2) / camera.focal_px, (rows - camera.height / 2) / camera.focal_px
        self.focal_px = camera.focal_px
        self.reset()

    def reset(self) -> None:
        """Go back to time 0."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[3:] = 0.3, 0.5, 1.1  # rad/s, in the body's axes

    def go_to(self, t_s: float) -> None:
        """Step the simulation to a time."""
        if self.data.time > t_s + 5e-4:
            self.reset()
        while self.data.time < t_s - 5e-4:
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def draw(self, image: Image) -> None:
        """Fill an image at the simulation's time."""
        self.renderer.update_scene(self.data, "evstim")
        image.light[:] = self.renderer.render().mean(axis=2)
        self.renderer.enable_depth_rendering()
        image.depth[:] = self.renderer.render()
        self.renderer.disable_depth_rendering()
        self.renderer.enable_segmentation_rendering()
        geom = self.renderer.render()[..., 0]
        self.renderer.disable_segmentation_rendering()
        image.motion[:] = self.motion(image.depth, geom >= 0)
        image.depth[geom < 0] = np.inf

    def motion(self, depth: np.ndarray, on_body: np.ndarray) -> np.ndarray:
        """Return the motion of the points that pixels show, px/s to the right and down; 0 for the sky."""
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
        to_camera = self.data.cam_xmat[0].reshape(3, 3).T * [[1], [-1], [-1]]  # axes of OpenCV: y down, z ahead
        turning, moving = to_camera @ velocity[:3], to_camera @ velocity[3:]
        centre = to_camera @ (self.data.xpos[1] - self.data.cam_xpos[0])
        point = np.stack((self.x * depth, self.y * depth, depth), axis=2)
        v = moving + np.cross(turning, point - centre)
        flow = self.focal_px * (v[..., :2] - np.stack((self.x, self.y), axis=2) * v[..., 2:]) / depth[..., None]
        return np.where(on_body[..., None], flow, 0.0)


def main(address: str) -> None:
    """Draw what evstim requests, until it ends."""
    layout = Images("uint8", white=255, motion=True, depth=True)
    with Renderer(address, layout, name=f"MuJoCo {mujoco.__version__}", wait_s=600) as renderer:
        scene = Tumbling(renderer.camera)
        for image in renderer:
            scene.go_to(image.t_ns * 1e-9)
            scene.draw(image)
            image.send()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:5560")
