"""Parallel grippers as boxes, and their tool centre points.

The frame of a grasp is that of the tool centre point, TCP, midway between the pads:

    z   approach direction, out of the palm
    y   closing direction of the fingers
    x   along the width of a finger

The fingers are boxes |x| <= finger_width / 2, opening / 2 <= |y| <= opening / 2 + finger_thickness, -palm <= z <= tip;
the hand is a box behind them, z <= -palm, long and wide enough to cover the approach path of hand and fingers as well.
Metres, newtons.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

import numpy as np

_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_BOX_FACES = np.array([corners for a, b, c, d in _QUADS for corners in ((a, b, c), (a, c, d))])


def _are_numbers(value: object, shape: tuple[int, ...]) -> bool:
    numbers = np.asarray(value)
    return numbers.dtype.kind in "iuf" and numbers.shape == shape and bool(np.isfinite(numbers).all())


@dataclass(frozen=True)
class Gripper:
    """A parallel gripper.

    Raises
    ------
    ValueError
        For a length or force that is not one positive and finite number, a hand that is not three, or a link_from_tcp
        that is no pose.
    """

    name: str
    opening: float
    """The largest distance between the pads."""
    finger_width: float
    """Along x."""
    finger_thickness: float
    """Along y."""
    tip: float
    """From the TCP to the fingers' ends."""
    palm: float
    """From the TCP back to the palm."""
    hand: tuple[float, float, float]
    """Full sizes of the box behind the palm."""
    force: float
    """The force of one finger when it holds."""
    link: str
    """The link of the gripper's model that the pose of the TCP is given in."""
    link_from_tcp: tuple[tuple[float, float, float], tuple[float, float, float, float]]
    """Position and quaternion x y z w of the TCP in that link: p_link = R p_tcp + t."""
    joints: tuple[str, ...] = ()
    """The fingers' joints in that model, each of which moves by half of the opening; none where fingers turn."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("name", "link", "link_from_tcp", "joints"):
                count = (3,) if field.name == "hand" else ()
                if not (_are_numbers(value, count) and np.greater(value, 0).all()):
                    expected = "three positive numbers" if count else "a positive number"
                    raise ValueError(f"{field.name}: expected {expected}, got {value!r}")
        place, turn = self.link_from_tcp if len(self.link_from_tcp) == 2 else ((), ())
        if not (_are_numbers(place, (3,)) and _are_numbers(turn, (4,)) and np.any(turn)):
            raise ValueError(f"link_from_tcp: expected a position and a quaternion, got {self.link_from_tcp}")

    def boxes(self, opening: float, reach: float = 0.1) -> np.ndarray:
        """Return centre and half sizes (3, 6) of both fingers and the hand in the TCP's frame, at an opening.

        The hand is longer by ``reach``, its straight approach in metres, and as wide as the open fingers, which come
        that way before it.
        """
        middle, long = 0.5 * (self.tip - self.palm), 0.5 * (self.tip + self.palm)
        aside = 0.5 * (opening + self.finger_thickness)
        x, y, z = self.hand
        if reach > 0:
            x, y = max(x, self.finger_width), max(y, self.opening + 2 * self.finger_thickness)
        z += reach
        finger = [0.5 * self.finger_width, 0.5 * self.finger_thickness, long]
        return np.array(
            [
                [0, aside, middle, *finger], [0, -aside, middle, *finger],
                [0, 0, -self.palm - 0.5 * z, 0.5 * x, 0.5 * y, 0.5 * z],
            ]
        )

    def boxes_at(self, openings: np.ndarray) -> np.ndarray:
        """Return :meth:`boxes` (k, 3, 6) at many openings (k,)."""
        closed = self.boxes(0.0)
        return np.asarray(closed + openings[:, None, None] * (self.boxes(1.0) - closed))

    def faces_at(self, openings: np.ndarray) -> np.ndarray:
        """Return places (k, 3, 9, 3) in the TCP's frame that a body must not reach, at many openings (k,).  On the pads
        of both fingers, from their middle to their end, and on the palm between them."""
        x, share = np.repeat([-0.8, 0.0, 0.8], 3), np.tile([0.0, 0.5, 1.0], 3)
        boxes, places = self.boxes_at(openings), np.empty((len(openings), 3, 9, 3))
        places[:, :, :, 0] = 0.5 * self.finger_width * x
        places[:, :2, :, 1] = np.stack([0.5 * openings, -0.5 * openings], axis=1)[:, :, None]
        places[:, :2, :, 2] = boxes[:, :2, 2, None] + boxes[:, :2, 5, None] * share
        places[:, 2, :, 1] = 0.8 * openings[:, None] * (share - 0.5)
        places[:, 2, :, 2] = -self.palm
        return places

    def mesh(self, opening: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (24, 3), faces (36, 3) and edges (36, 2, 3) of fingers and hand in the TCP's frame."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        vertices = np.concatenate([box[:3] + signs * box[3:] for box in self.boxes(opening, reach=0.0)])
        faces = np.concatenate([_BOX_FACES + 8 * k for k in range(3)])
        pairs = [(i, j) for i in range(8) for j in range(i) if np.abs(signs[i] - signs[j]).sum() == 2]
        edges = np.concatenate([np.array(pairs) + 8 * k for k in range(3)])
        return vertices, faces, vertices[edges]

    def wires(self, opening: float) -> list[np.ndarray]:
        """Return lines (j, 3) in the TCP's frame that draw the gripper: the fork of its fingers and its wrist."""
        fork = np.array([[0, 0.5, self.tip], [0, 0.5, -self.palm], [0, -0.5, -self.palm], [0, -0.5, self.tip]])
        wrist = np.array([[0.0, 0.0, -self.palm], [0.0, 0.0, -self.palm - self.hand[2]]])
        return [fork * [1.0, opening, 1.0], wrist]


PANDA = Gripper(
    name="panda", opening=0.080, finger_width=0.0175, finger_thickness=0.0152, tip=0.0095, palm=0.0374,
    hand=(0.063, 0.204, 0.066), force=70.0, link="panda_hand", link_from_tcp=((0.0, 0.0, 0.1034), (0.0, 0.0, 0.0, 1.0)),
    joints=("panda_finger_joint1", "panda_finger_joint2"),
)
"""Franka Hand.  Opening 80 mm, 70 N without end: its data sheet.  Boxes of pads and hand, TCP, joints:
franka_description."""

ROBOTIQ_2F_85 = Gripper(
    name="robotiq_2f_85", opening=0.085, finger_width=0.022, finger_thickness=0.014, tip=0.019, palm=0.0335,
    hand=(0.075, 0.165, 0.108), force=100.0, link="robotiq_85_base_link",
    link_from_tcp=((0.0, 0.0, 0.1415), (0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5)))),
)
"""Robotiq 2F-85.  Stroke 85 mm, 20 to 235 N: its manual.  The rest follows from the joints in ROS-Industrial's model of
it (robotiq_2f_85_gripper_visualization): pads of 22 x 37.5 mm; their middle, the TCP, at half of the stroke, from which
it moves by -11 and +3 mm when the gripper opens and closes; the hand reaches 10 mm beyond the joints of the fingers
when they are wide open.  The thickness of a finger, to half a centimetre, is that of its end."""

ROBOTIQ_2F_140 = Gripper(
    name="robotiq_2f_140", opening=0.140, finger_width=0.027, finger_thickness=0.018, tip=0.0325, palm=0.0535,
    hand=(0.075, 0.210, 0.141), force=100.0, link="robotiq_140_base_link",
    link_from_tcp=((0.0, 0.0, 0.1945), (0.0, 0.0, 0.0, 1.0)),
)
"""Robotiq 2F-140.  Stroke 140 mm, 10 to 125 N: its manual; the rest as for the 2F-85: pads of 27 x 65 mm; the TCP moves
by -18 and +6 mm."""

GRIPPERS: Mapping[str, Gripper] = MappingProxyType(
    {gripper.name: gripper for gripper in (PANDA, ROBOTIQ_2F_85, ROBOTIQ_2F_140)}
)


def gripper(name: str) -> Gripper:
    """Return the preset of this name; a ValueError if there is none."""
    if name not in GRIPPERS:
        raise ValueError(f"gripper: expected one of {', '.join(GRIPPERS)}, got {name!r}")
    return GRIPPERS[name]
