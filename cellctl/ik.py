"""Numeric inverse kinematics: Levenberg-Marquardt on the pose error, many starts at once.

Works for any `ArmModel`; a pose has up to eight solutions, so several starts find several.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.arms import JOINTS, ArmModel
from cellctl.geometry import Array, Mask

POSITION_TOLERANCE_M = 1e-6
ANGLE_TOLERANCE_RAD = 1e-6
ANGLE_WEIGHT_M = 0.3
"""One radian counts like this many metres while the iteration runs."""


def pose_errors(frames: Array, targets: Array) -> Array:
    """(n, 6) position error in metres and rotation error in radians, base axes."""
    turn = targets[:, :3, :3] @ np.swapaxes(frames[:, :3, :3], 1, 2)
    return np.concatenate(
        [targets[:, :3, 3] - frames[:, :3, 3], Rotation.from_matrix(turn).as_rotvec()], axis=1
    )


def refine(
    arm: ArmModel, targets: Array, starts: Array, iterations: int = 40
) -> tuple[Array, Mask]:
    """Joints (n, 6) reached from `starts` (n, 6) towards `targets` (n, 4, 4), and whether each
    converged (n,). Joint limits are not considered."""
    joints = np.array(starts, dtype=float)
    weights = np.array([1.0] * 3 + [ANGLE_WEIGHT_M] * 3)
    damping = np.full(len(joints), 1e-3)
    errors, cost, frames = _evaluate(arm, joints, targets, weights)
    for _ in range(iterations):
        step = _step(arm.jacobian(frames), errors, weights, damping)
        trial = joints + np.clip(step, -0.5, 0.5)
        new_errors, new_cost, new_frames = _evaluate(arm, trial, targets, weights)
        better = new_cost < cost
        joints[better], errors[better] = trial[better], new_errors[better]
        cost[better], frames[better] = new_cost[better], new_frames[better]
        damping = np.clip(np.where(better, damping * 0.3, damping * 4.0), 1e-9, 1e2)
        if (cost < 1e-16).all():
            break
    return joints, _converged(errors)


def solutions(
    arm: ArmModel, targets: Array, near: Array, starts: Array, margin: float = 0.05
) -> list[Array]:
    """For each of `targets` (n, 4, 4) the distinct solutions (k, 6) inside the joint limits,
    nearest to `near` (6,) first; (0, 6) where there is none.

    `starts` (m, 6) are tried for every target; full turns are chosen nearest to `near`.
    """
    count, tries = len(targets), len(starts)
    if count == 0:
        return []
    joints, converged = refine(arm, np.repeat(targets, tries, axis=0), np.tile(starts, (count, 1)))
    joints = near_turns(arm, joints, near)
    good = converged & arm.within_limits(joints, margin)
    joints, good = joints.reshape(count, tries, JOINTS), good.reshape(count, tries)
    return [_distinct(q[ok], near) for q, ok in zip(joints, good, strict=True)]


def near_turns(arm: ArmModel, joints: Array, near: Array) -> Array:
    """Add full turns so that every joint is nearest to `near`, as far as the limits allow."""
    turns = joints + 2 * np.pi * np.round((near - joints) / (2 * np.pi))
    turns = np.where(turns > arm.limits[:, 1], turns - 2 * np.pi, turns)
    return np.where(turns < arm.limits[:, 0], turns + 2 * np.pi, turns)


def random_starts(arm: ArmModel, count: int, seed: int) -> Array:
    """`count` joint vectors (count, 6) spread over the working half turn of each joint."""
    low = np.maximum(arm.limits[:, 0], -np.pi)
    high = np.minimum(arm.limits[:, 1], np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, JOINTS))


def _evaluate(
    arm: ArmModel, joints: Array, targets: Array, weights: Array
) -> tuple[Array, Array, Array]:
    frames = arm.link_frames(joints)
    errors = pose_errors(frames[:, JOINTS], targets)
    return errors, ((errors * weights) ** 2).sum(axis=1), frames


def _step(jacobian: Array, errors: Array, weights: Array, damping: Array) -> Array:
    weighted = jacobian * weights[:, None]
    normal = np.swapaxes(weighted, 1, 2) @ weighted
    normal += damping[:, None, None] * np.eye(JOINTS) * 0.1
    right = np.swapaxes(weighted, 1, 2) @ (errors * weights)[..., None]
    return np.linalg.solve(normal, right)[..., 0]


def _converged(errors: Array) -> Mask:
    near = np.linalg.norm(errors[:, :3], axis=1) < POSITION_TOLERANCE_M
    return np.logical_and(near, np.linalg.norm(errors[:, 3:], axis=1) < ANGLE_TOLERANCE_RAD)


def _distinct(joints: Array, near: Array) -> Array:
    """The different rows of `joints` (n, 6), nearest to `near` first."""
    kept: list[Array] = []
    for row in joints[np.argsort(np.abs(joints - near).max(axis=1), kind="stable")]:
        if all(np.abs(row - other).max() > 1e-3 for other in kept):
            kept.append(row)
    return np.array(kept).reshape(-1, JOINTS)
