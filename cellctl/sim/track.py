"""The ways that an arm follows in joint space: straight lines and smooth curves.

Where the arm is along a track is told by its way, 0 at the track's start and 1 at its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from cellctl.errors import MotionRefused
from cellctl.geometry import Array

NEAREST_M = 0.2e-3
"""Waypoints of a stroke nearer to each other are one: noise between them would be a corner."""
FARTHEST_M = 1.5e-3
JOINT_LEVER_M = 0.02
"""A radian of any joint counts at least as this much way: the pen may turn on the spot."""
BEND_SHARE = 0.5
"""Of the acceleration, what the curve itself may need at full speed."""


class Track(Protocol):
    def at(self, way: Array) -> tuple[Array, Array]:
        """Joints and their change a unit of way, (n, 6) each, at ways (n,)."""
        ...

    def hardest(self, acceleration: Array, speed: float) -> float:
        """The deceleration of the way that joints with these limits (6,) allow at `speed`."""
        ...


@dataclass(frozen=True, eq=False)
class Straight:
    """From `start` (6,) along `delta` (6,)."""

    start: Array
    delta: Array

    def at(self, way: Array) -> tuple[Array, Array]:
        return self.start + way[:, None] * self.delta, np.tile(self.delta, (len(way), 1))

    def hardest(self, acceleration: Array, speed: float) -> float:  # noqa: ARG002 (no bends)
        return float((acceleration / np.maximum(np.abs(self.delta), 1e-9)).min())


class Curve:
    """A cubic spline through joints, its way proportional to that of the tool's tip."""

    def __init__(self, joints: Array, tips: Array) -> None:
        """Joints (n, 6), n > 1, and where the tip is at them (n, 3)."""
        way = np.concatenate([[0.0], np.cumsum(_steps(joints, tips))])
        self.length = float(way[-1])
        self._spline = CubicSpline(way / self.length, joints, bc_type="natural")
        knots = self._spline.x
        at = np.sort(np.concatenate([knots, (knots[:-1] + knots[1:]) / 2]))
        self._slope = np.maximum(np.abs(self._spline(at, 1)), 1e-9)
        self._bend = np.abs(self._spline(at, 2))

    def at(self, way: Array) -> tuple[Array, Array]:
        return self._spline(way), self._spline(way, 1)

    def hardest(self, acceleration: Array, speed: float) -> float:
        left = acceleration - self._bend * speed**2
        return float((np.maximum(left, 0.1 * acceleration) / self._slope).min())

    def rate(self, speed: Array, acceleration: Array, tip_speed: float) -> float:
        """The constant speed of the way under joint limits (6,) and that of the tip, m/s."""
        joints = float((speed / self._slope).min())
        bends = float(np.sqrt(BEND_SHARE * acceleration / np.maximum(self._bend, 1e-9)).min())
        return min(tip_speed / self.length, joints, bends)


def thinned(joints: Array, tips: Array) -> Array:
    """Which rows of a stroke's joints (n, 6) with tips (n, 3) to go through: the first, the last,
    and none nearer to its neighbours than NEAREST_M. MotionRefused when two are far apart or all
    are in one place."""
    steps = _steps(joints, tips)
    if len(steps) and steps.max() > FARTHEST_M:
        worst = int(steps.argmax())
        before = f"waypoint {worst - 1}" if worst else "where the pen is"
        raise MotionRefused(
            f"a stroke's waypoint {worst} is {1e3 * steps[worst]:.1f} mm of the tip from {before}; "
            "they may be a millimetre apart"
        )
    way, kept = np.concatenate([[0.0], np.cumsum(steps)]), [0]
    if way[-1] < NEAREST_M:
        raise MotionRefused(f"a stroke of {1e3 * way[-1]:.2f} mm is too short to be followed")
    for i in range(1, len(way)):
        if way[i] - way[kept[-1]] >= NEAREST_M and way[-1] - way[i] >= NEAREST_M:
            kept.append(i)
    return np.array([*kept, len(way) - 1])


def _steps(joints: Array, tips: Array) -> Array:
    tip = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    return np.maximum(tip, JOINT_LEVER_M * np.abs(np.diff(joints, axis=0)).max(axis=1))
