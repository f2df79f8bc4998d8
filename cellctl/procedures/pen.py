"""How the pen is led: straight down, turned about the vertical, lowered and lifted along the
table's normal. Pure: from tip positions to joints, on the one branch of the arm that draws.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl import ik
from cellctl.arms import JOINTS
from cellctl.config import CellConfig
from cellctl.drivers.base import Stroke
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, Mask, pose_matrix
from cellctl.motion import PEN, Guard

STEP_M = 1e-3
"""Between two points of a stroke."""
FILLET_M = 0.01
"""How high above the lowest point a stroke begins to bend into its circle."""
LIFT_SPARE_M = 0.018
UP = np.array([0.0, 0.0, 1.0])
DOWN = np.diag([1.0, -1.0, -1.0])
STARTS = 24
MOST_TURN_RAD = 0.1
"""Of a joint between two points of a stroke; more means that the arm changes its branch."""


class Surface(Protocol):
    """The table."""

    def height(self, xy: Array) -> Array:
        """z (n,) at xy (n, 2), in the world, metres."""
        ...


@dataclass(frozen=True, eq=False)
class PenRig:
    """What leading the pen needs. `tip` (3,) in the flange frame as the config says; `posture` (6,)
    is on the branch that draws, `upright` (3, 3) the tool's orientation there, made upright;
    `normal` (3,) is the table's."""

    guard: Guard
    tip: Array
    posture: Array
    upright: Array
    surface: Surface
    normal: Array
    depth: float
    lift: float

    def flanges(self, tips: Array, yaw: Array) -> Array:
        """T_world_flange (n, 4, 4) with the pen upright on tips (n, 3), turned by yaw (n,) about
        the vertical from where it is upright."""
        poses = np.tile(np.eye(4), (len(tips), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(yaw[:, None] * UP).as_matrix() @ self.upright
        poses[:, :3, 3] = tips - poses[:, :3, :3] @ self.tip
        return poses

    def over(self, xy: Array, height: float) -> Array:
        """Points (n, 3), `height` over the table along its normal."""
        return self.on_table(xy) + height * self.normal

    def on_table(self, xy: Array) -> Array:
        """World points (n, 3) of xy (n, 2)."""
        return np.column_stack([xy, self.surface.height(xy)])

    def joints(self, tips: Array, yaw: Array, near: Array) -> tuple[Array, Mask]:
        """Joints (n, 6) with the pen on tips (n, 3) at yaw (n,), near to `near` (n, 6), and which
        of them were found within the limits."""
        arm = self.guard.arm
        joints, found = ik.refine(arm, self.flanges(tips, yaw), near)
        joints = ik.near_turns(arm, joints, near)
        return joints, np.logical_and(found, arm.within_limits(joints))

    def postures(self, xy: Array, yaw: Array, height: float) -> tuple[Array, Mask]:
        """As `joints`, for the pen `height` over the table at xy (n, 2), on the drawing branch."""
        tips = self.over(xy, height)
        start = np.tile(self.posture, (len(xy), 1))
        upright, found = self.joints(tips, np.zeros(len(xy)), start)
        turned = upright.copy()
        turned[:, JOINTS - 1] -= yaw
        joints, turned_found = self.joints(tips, yaw, turned)
        return joints, np.logical_and(found, turned_found)


def pen_rig(
    config: CellConfig, guard: Guard, surface: Surface, normal: Array, here: Array
) -> PenRig:
    """The rig of a configured cell; `here` (6,) decides the branch where the config does not.

    MotionRefused when the pen cannot stand upright over the middle of the table.
    """
    pen = config.bracket.pen
    tip = np.array(pen.tip_m)
    if pen.posture_deg is not None:
        posture = np.radians(pen.posture_deg)
        upright = _upright(guard.arm.forward(posture)[:3, :3], tip)
    else:
        posture, upright = _found_posture(config, guard, tip, here), DOWN
    return PenRig(
        guard, tip, posture, upright, surface, normal, pen.travel_m / 2, free_height(guard)
    )


def free_height(guard: Guard) -> float:
    """So high over the table, metres, the tip stands freely, and a little more."""
    radius = max(float(body.radii.max()) for body in guard.bodies if body.name == PEN)
    return guard.clearance + radius + LIFT_SPARE_M


def _upright(rotation: Array, tip: Array) -> Array:
    """`rotation` (3, 3) turned by the least angle that makes the tool's axis point down."""
    axis = rotation @ (tip / np.linalg.norm(tip))
    down = np.array([0.0, 0.0, -1.0])
    sine = np.cross(axis, down)
    angle = np.arctan2(np.linalg.norm(sine), axis @ down)
    turn = sine / max(float(np.linalg.norm(sine)), 1e-12) * angle
    return pose_matrix(turn, (0.0, 0.0, 0.0))[:3, :3] @ rotation


def _found_posture(config: CellConfig, guard: Guard, tip: Array, here: Array) -> Array:
    x, y, _ = config.table.pose.position_m
    pose = np.eye(4)
    pose[:3, :3] = DOWN
    pose[:3, 3] = np.array([x, y, config.table.touched_height_m]) - DOWN @ tip
    starts = np.vstack([here, ik.random_starts(guard.arm, STARTS, seed=0)])
    found = ik.solutions(guard.arm, pose[None], here, starts)[0]
    if not len(found):
        raise MotionRefused("the pen cannot stand upright over the middle of the table")
    return np.array(found[0])


def line(points: Array, step: float = STEP_M) -> Array:
    """Points (m, 3) along the polyline `points` (n, 3), at most `step` apart, corners included."""
    pieces = [points[:1]]
    for a, b in itertools.pairwise(points):
        count = max(int(np.ceil(np.linalg.norm(b - a) / step)), 1)
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.vstack(pieces)


def circle(rig: PenRig, centre: Array, radius: float) -> Array:
    """Tips (n, 3) that come down onto a circle about `centre` (2,), draw it, and go up again.

    From straight down the way bends into the circle over a quarter of a turn of FILLET_M in
    height, and out of it likewise, always above or on the circle: the pen need not slow down for
    a corner, and leaves no ink but on the circle.
    """
    bend = np.linspace(0.0, np.pi / 2, int(np.ceil(np.pi / 2 * FILLET_M / STEP_M)) + 1)
    before, height = FILLET_M * np.cos(bend), FILLET_M * (1.0 - np.sin(bend)) - rig.depth
    around = np.linspace(0.0, 2 * np.pi, int(np.ceil(2 * np.pi * radius / STEP_M)) + 1)[1:-1]
    angles = np.concatenate([-before / radius, around, (2 * np.pi + before / radius)[::-1]])
    heights = np.concatenate([height, np.full(len(around), -rig.depth), height[::-1]])
    xy = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    tips = rig.on_table(xy) + heights[:, None] * rig.normal
    ends = rig.over(xy[[0, -1]], rig.lift)
    down, up = line(np.vstack([ends[:1], tips[:1]])), line(np.vstack([tips[-1:], ends[1:]]))
    return np.vstack([down[:-1], tips, up[1:]])


def stroke(rig: PenRig, tips: Array, yaw: float, speed_m_s: float) -> Stroke:
    """The stroke that leads the pen along tips (n, 3). MotionRefused when the arm cannot follow, or
    the guard does not allow it."""
    start, reached = rig.postures(tips[:1, :2], np.array([yaw]), rig.lift)
    joints, followed = rig.joints(tips, np.full(len(tips), yaw), np.tile(start, (len(tips), 1)))
    jump = np.abs(np.diff(joints, axis=0)).max(initial=0.0)
    if not (reached.all() and followed.all()) or jump > MOST_TURN_RAD:
        raise MotionRefused("the arm cannot follow this line with the pen upright")
    found = Stroke(joints, speed_m_s)
    rig.guard.check_stroke(found)
    return found


def lifted(guard: Guard, here: Array, speed_m_s: float) -> Stroke | None:
    """Straight up from joints `here` (6,), as the tool is turned, until the arm stands freely.

    None when it stands freely already, or when that would not be allowed.
    """
    if guard.pen is None or guard.free(here[None])[0] or not guard.draws(here[None])[0]:
        return None
    flange = guard.arm.forward(here)
    lift = free_height(guard) + guard.pen.travel
    count = int(np.ceil(lift / STEP_M)) + 1
    poses = np.tile(flange, (count, 1, 1))
    poses[:, 2, 3] += np.linspace(0.0, lift, count)
    joints, found = ik.refine(guard.arm, poses, np.tile(here, (count, 1)))
    joints[0] = here
    return Stroke(joints, speed_m_s) if found.all() else None
