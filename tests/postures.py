"""Postures of the test cell's arm."""

from __future__ import annotations

import numpy as np

from cellctl import ik
from cellctl.geometry import Array, pose_matrix
from cellctl.motion import Guard

ABOVE = np.radians([-90.0, -110.0, 110.0, -90.0, -90.0, 90.0])
"""The flange points down, high over the near edge of the table."""


def pen_at(guard: Guard, x: float, y: float, z: float, near: Array = ABOVE) -> Array:
    """Joints (n, 6) with the pen straight down at (x, y, z), turned in eight ways."""
    turns = [pose_matrix((0, 0, yaw), (x, y, z + 0.18)) for yaw in np.arange(8) * np.pi / 4]
    poses = np.array(turns) @ pose_matrix((np.pi, 0, 0), (0, 0, 0))
    starts = np.vstack([near, ik.random_starts(guard.arm, 20, seed=5)])
    return np.concatenate(ik.solutions(guard.arm, poses, near, starts))


def free_pen_at(guard: Guard, x: float, y: float, z: float, near: Array = ABOVE) -> Array:
    """The allowed one of them that is nearest to `near`."""
    joints = pen_at(guard, x, y, z, near)
    joints = joints[guard.free(joints)]
    assert len(joints), f"the test needs a free posture at ({x}, {y}, {z})"
    return joints[np.argmin(np.abs(joints - near).max(axis=1))]
