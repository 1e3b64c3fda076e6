"""A simulated arm clears a table: depth camera, recover_node, grasp_node, inverse kinematics, physics.

    python pick_with_an_arm.py [--film FILE.gif]        (ROS 2 or the extra 'ros', and the extra 'picking')

Starts both nodes.  The camera sees the table by MuJoCo's rays, with the noise of a RealSense.  The arm has the joints
and lengths of a Franka Panda.  After each pick the camera looks again.

World: arm at the origin, x ahead, z up, metres.
"""

import argparse
import subprocess
import sys
import time

import mujoco
import numpy as np
import rclpy
from PIL import Image as Picture
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py import grasps
from sq_msgs_py.depth_image import Intrinsics, depth_to_message, intrinsics_to_message
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping.gripper import PANDA
from sq_perception.imaging.camera import Camera as Pinhole
from sq_perception.simulation.sensor_noise import preset

STEP = 0.002
HOME = np.array([2.0, -0.6, 0.0, -2.4, 0.0, 1.8, 0.8])
BIN = 2.4
"""Angle about the arm at which things are let go into a tray, out of the camera's view."""
LINKS = [  # place in the link before it, its turn about x in quarters, limits of the joint
    ((0, 0, 0.333), 0, (-2.9, 2.9)),
    ((0, 0, 0), -1, (-1.76, 1.76)),
    ((0, -0.316, 0), 1, (-2.9, 2.9)),
    ((0.0825, 0, 0), 1, (-3.07, -0.07)),
    ((-0.0825, 0.384, 0), -1, (-2.9, 2.9)),
    ((0, 0, 0), 1, (0.0, 3.75)),
    ((0.088, 0, 0), 1, (-2.9, 2.9)),
]
FLANGE = 0.107 + PANDA.link_from_tcp[0][2]
"""Metres from the last joint to the point between the fingers, where the hand is turned by -45 degrees."""
THINGS = (
    '<geom type="cylinder" size="0.033 0.058" {}/>', '<geom type="box" size="0.03 0.045 0.05" {}/>',
    '<geom type="ellipsoid" size="0.034 0.034 0.034" {}/>', '<geom type="cylinder" size="0.025 0.08" {}/>',
)  # fmt: skip
PLACES = ((0.46, -0.16, 0.06), (0.60, -0.05, 0.052), (0.42, 0.02, 0.036), (0.55, 0.13, 0.082))
COLOURS = np.array([[0.80, 0.36, 0.30], [0.33, 0.53, 0.75], [0.93, 0.72, 0.30], [0.45, 0.65, 0.42]])


def model() -> mujoco.MjModel:
    """Make the arm, the table and the things."""
    pad, density = 'friction="0.8 0.005 0.001" condim="6" solref="0.004 1"', ' density="400"'
    ghost = 'group="1" contype="0" conaffinity="0"'  # links touch nothing, least of all each other
    left, right, _ = PANDA.boxes(0.0, reach=0.0)
    x, y, z = PANDA.hand
    fingers = "".join(
        f'<body><joint name="{name}" type="slide" axis="0 {side} 0" range="0 0.04" damping="5" armature="0.2"/><geom '
        f'type="box" pos="{box[0]} {box[1]} {box[2]}" size="{box[3]} {box[4]} {box[5]}" mass="0.015" {pad}/></body>'
        for name, side, box in (("left", 1, left), ("right", -1, right))
    )
    arm = (
        f'<body name="tcp" pos="0 0 {FLANGE}" quat="0.92388 0 0 -0.38268" gravcomp="1"><geom type="box" '
        f'pos="0 0 {-PANDA.palm - z / 2}" size="{x / 2} {y / 2} {z / 2}" mass="0.7"/>{fingers}</body>'
    )
    for number, ((px, py, pz), turn, (low, high)) in reversed(list(enumerate(LINKS))):
        after = LINKS[number + 1][0] if number < 6 else (0, 0, 0.1)
        tube = f'<geom type="capsule" fromto="0 0 0 {after[0]} {after[1]} {after[2]}" size="0.05" mass="2" {ghost}/>'
        tube = tube if any(after) else f'<geom type="sphere" size="0.06" mass="2" {ghost}/>'
        arm = (
            f'<body pos="{px} {py} {pz}" quat="{np.cos(turn * np.pi / 4)} {np.sin(turn * np.pi / 4)} 0 0" gravcomp="1">'
            f'<joint name="j{number}" axis="0 0 1" range="{low} {high}" damping="20" armature="0.3"/>{tube}{arm}</body>'
        )
    things = "".join(
        f'<body pos="{px} {py} {pz}"><freejoint/>{shape.format(pad + density)}</body>'
        for shape, (px, py, pz) in zip(THINGS, PLACES, strict=True)
    )
    tray = "".join(
        f'<geom type="box" pos="{-0.39 + 0.2 * ax} {0.36 + 0.2 * ay} 0.04" size="{0.2 - 0.19 * abs(ax)} '
        f'{0.2 - 0.19 * abs(ay)} 0.04" group="1"/>'
        for ax, ay in ((1, 0), (-1, 0), (0, 1), (0, -1))
    )
    drives = "".join(f'<position joint="j{k}" kp="4000" kv="400"/>' for k in range(7))
    finger = '<position joint="{}" kp="2000" kv="100" forcerange="-70 70"/>'
    drives += finger.format("left") + finger.format("right")
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><compiler angle="radian"/><option timestep="{STEP}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
  <geom type="plane" size="0 0 1" {pad}/><geom type="cylinder" pos="0 0 0.14" size="0.07 0.14" {ghost}/>
  {arm}{tray}{things}</worldbody><actuator>{drives}</actuator></mujoco>""")


class Camera:
    """A pinhole camera that looks at a point of the world."""

    def __init__(self, width: int, height: int, focal: float, eye: tuple, target: tuple) -> None:
        self.intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self.eye = np.array(eye)
        forward = np.array(target) - self.eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        i = self.intrinsics
        self.rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)

    def look(self, world: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return z depth (height, width), NaN where nothing is, and the geoms seen."""
        count, i = len(self.rays), self.intrinsics
        geoms, depth = np.full(count, -1, np.int32), np.zeros(count)
        rays = (self.rays @ self.rotation.T).ravel()
        mujoco.mj_multiRay(world, data, self.eye, rays, None, 1, -1, geoms, depth, count, 100.0)
        return np.where(geoms < 0, np.nan, depth).reshape(i.height, i.width), geoms.reshape(i.height, i.width)


class Robot:
    """The arm: moves the tool centre point, opens and closes."""

    def __init__(self, world: mujoco.MjModel, film: list[np.ndarray] | None) -> None:
        self.world, self.data, self.film = world, mujoco.MjData(world), film
        self.aside = Camera(360, 260, 400.0, (1.25, -0.95, 0.75), (0.22, 0.05, 0.28))
        self.data.qpos[:7], self.data.ctrl[:7] = HOME, HOME
        self.open(PANDA.opening, 1.0)

    def step(self, seconds: float) -> None:
        for _ in range(int(seconds / STEP)):
            mujoco.mj_step(self.world, self.data)
            if self.film is not None and int(self.data.time / STEP) % 90 == 0:
                self.film.append(shade(self.world, self.data, self.aside))

    def open(self, opening: float, seconds: float = 0.6) -> None:
        self.data.ctrl[7:] = opening / 2
        self.step(seconds)

    def go(self, joints: np.ndarray, seconds: float) -> None:
        start = self.data.ctrl[:7].copy()
        for share in np.linspace(0, 1, int(seconds / 0.02)):
            self.data.ctrl[:7] = start + (joints - start) * (3 - 2 * share) * share**2
            self.step(0.02)
        self.step(0.2)

    def joints_at(self, place: np.ndarray, turn: np.ndarray, start: np.ndarray) -> np.ndarray | None:
        """Find joints for a pose of the tool by damped least squares; None where it is out of reach."""
        data = mujoco.MjData(self.world)
        tcp, jacobian = self.world.body("tcp").id, np.zeros((6, self.world.nv))
        limits, joints = self.world.jnt_range[:7].T, start.copy()
        for _ in range(300):
            data.qpos[:7] = joints
            mujoco.mj_kinematics(self.world, data)
            mujoco.mj_comPos(self.world, data)
            axis = quaternions.from_matrix(turn @ data.xmat[tcp].reshape(3, 3).T)
            error = np.concatenate([place - data.xpos[tcp], 2 * axis[:3] * np.sign(axis[3])])
            if np.abs(error).max() < 1e-3:
                return joints
            mujoco.mj_jacBody(self.world, data, jacobian[:3], jacobian[3:], tcp)
            j = jacobian[:, :7]
            step = j.T @ np.linalg.solve(j @ j.T + 1e-3 * np.eye(6), error)
            joints = np.clip(joints + np.clip(step, -0.2, 0.2), limits[0], limits[1])
        return None

    def pick(self, place: np.ndarray, turn: np.ndarray, opening: float) -> bool | None:
        """Take what is there to the bin; whether it is held, None where the arm does not reach."""
        azimuth = np.arctan2(place[1], place[0])
        ahead = np.concatenate([[azimuth], HOME[1:]])
        for half in (np.diag([1.0, 1, 1]), np.diag([-1.0, -1, 1])):  # the fingers are alike
            before = self.joints_at(place - 0.1 * turn[:, 2], turn @ half, ahead)
            there = None if before is None else self.joints_at(place, turn @ half, before)
            up = None if there is None else self.joints_at(place + [0, 0, 0.2], turn @ half, there)
            if up is not None:
                break
        else:
            return None
        self.open(min(opening + 0.02, PANDA.opening))
        self.go(before, 1.6)
        self.go(there, 1.0)
        self.open(0.0, 1.0)
        self.go(up, 1.0)
        held = bool(self.data.qpos[7:9].sum() > 0.004)
        self.go(np.concatenate([[up[0] + BIN - azimuth], up[1:]]), 1.8)
        self.open(PANDA.opening)
        self.go(HOME, 1.2)
        return held


def shade(world: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> np.ndarray:
    """Draw the scene (height, width, 3) by its depth, lit from the left."""
    depth, geoms = camera.look(world, data)
    points = camera.rays.reshape(*depth.shape, 3) * depth[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    light = normal @ np.array([0.4, 0.7, 0.6]) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)
    colours = np.full((world.ngeom, 3), 0.25)
    colours[0], colours[world.geom_group == 1], colours[-len(THINGS) :] = (0.9, 0.89, 0.86), (0.93, 0.94, 0.96), COLOURS
    image = np.where(geoms[..., None] < 0, 1.0, colours[geoms] * (0.35 + 0.65 * np.clip(light, 0, 1))[..., None])
    return (255 * image).astype(np.uint8)


class Eyes:
    """The ROS side: publishes what the camera sees, and waits for grasps of it in the world's frame."""

    def __init__(self, camera: Camera) -> None:
        self.camera, self.heard = camera, list[PointCloud2]()
        self.noise, self.rng = preset("realsense_d435"), np.random.default_rng(0)
        self.node = rclpy.create_node("camera")
        self.images = self.node.create_publisher(Image, "depth/image", 1)
        self.infos = self.node.create_publisher(CameraInfo, "depth/camera_info", 1)
        self.node.create_subscription(PointCloud2, "grasp_node/grasp_details", self.heard.append, 10)

    def grasps(self, depth: np.ndarray) -> grasps.GraspArray:
        """Publish a depth image until its grasps come back."""
        i = self.camera.intrinsics
        measured = self.noise.measure(depth, Pinhole(i.width, i.height, i.fx, i.fy, i.cx, i.cy), self.rng)
        first = time.time()
        while rclpy.ok() and time.time() < first + 600:  # the first answer compiles
            header = Header(stamp=self.node.get_clock().now().to_msg(), frame_id="camera_depth_optical_frame")
            self.infos.publish(intrinsics_to_message(i, header))
            self.images.publish(depth_to_message(measured, header))
            end = time.time() + 1.0
            while time.time() < end:
                rclpy.spin_once(self.node, timeout_sec=0.1)
                new = [each for each in self.heard if each.header.stamp.sec >= int(first)]
                if new:
                    return grasps.from_message(new[-1])
        raise SystemExit("no grasps came back: see the nodes' messages")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--film", metavar="FILE", help="write a GIF of the arm")
    film = parser.parse_args().film
    frames: list[np.ndarray] | None = [] if film else None
    world = model()
    camera = Camera(640, 480, 600.0, (0.55, -0.62, 0.55), (0.5, -0.02, 0.03))
    wires = [word for one in ("superquadrics", "support_plane") for word in ("-r", f"{one}:=recover_node/{one}")]
    run = "import sys; from sq_perception.nodes import executables; sys.exit(executables.{}())"
    nodes = [
        subprocess.Popen([sys.executable, "-c", run.format(name), "--ros-args", *words])
        for name, words in (("recover_node", []), ("grasp_node", wires))
    ]
    rclpy.init()
    try:
        return clear(Robot(world, frames), Eyes(camera))
    finally:
        for node in nodes:
            node.terminate()
        if frames:
            palette = Picture.fromarray(np.concatenate(frames[:: len(frames) // 8])).quantize(128, kmeans=4)
            plain = {"palette": palette, "dither": Picture.Dither.NONE}
            pictures = [Picture.fromarray(frame).quantize(**plain) for frame in frames]
            pictures[0].save(film, save_all=True, append_images=pictures[1:], duration=90, loop=0, optimize=True)


def clear(robot: Robot, eyes: Eyes) -> int:
    """Pick until nothing is left that the arm can take; return 0 if the table is empty."""
    for _ in range(2 * len(THINGS)):
        depth, geoms = eyes.camera.look(robot.world, robot.data)
        left = np.unique(geoms[geoms >= robot.world.ngeom - len(THINGS)])
        if not len(left):
            print("the table is empty")
            return 0
        found = eyes.grasps(depth)
        for k in range(len(found.score)):
            place = eyes.camera.rotation @ found.position[k] + eyes.camera.eye
            turn = eyes.camera.rotation @ quaternions.to_matrix(found.rotation[k])
            held = robot.pick(place, turn, float(found.opening[k]))
            if held is not None:
                print(f"{len(left)} things seen, {len(found.score)} grasps: {'held' if held else 'missed'} one of "
                      f"{found.score[k]:.2f} at {place.round(2)}", flush=True)  # fmt: skip
                break
        else:
            print(f"{len(left)} things seen, none within reach")
            return 1
    return 1


if __name__ == "__main__":
    sys.exit(main())
