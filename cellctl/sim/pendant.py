"""A person who moves the arm with the pendant: no guard, a good eye, and some sense."""

from __future__ import annotations

import numpy as np

from cellctl import ik
from cellctl.arms import JOINTS
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, pose_matrix
from cellctl.sim.motion import Limits
from cellctl.sim.noise import keyed
from cellctl.sim.world import World

SLOWLY = Limits(np.radians(np.full(JOINTS, 30.0)), np.radians(np.full(JOINTS, 60.0)), 0.25)
ABOVE_M = 0.05
"""A person lifts the pen by this before moving it over the table."""
STARTS = 24


def jog(world: World, joints: Array) -> float:
    """Jog straight to joints (6,); returns when the motion will end."""
    return world.move(joints[None], SLOWLY)


def place(world: World, point: Array, rotation: Array) -> float:
    """Jog until the true pen tip stands on `point` (3,) of the world, as well as an eye sees it,
    with the flange turned as `rotation` (3, 3); returns when the motion will end. MotionRefused
    when that is out of reach."""
    truth, index = world.truth, world.index("place", None)
    rng, errors = keyed(truth.seed, "place", index), truth.preset.arm_errors
    seen = point + rng.normal(0.0, truth.preset.pen.eye_sigma_m, 3)
    spread = np.repeat([errors.repeat_sigma_m, np.radians(errors.repeat_sigma_deg)], 3)
    slip = rng.normal(0.0, 1.0, 6) * spread
    target = np.eye(4)
    target[:3, :3], target[:3, 3] = rotation, seen - rotation @ truth.pen
    above = target.copy()
    above[:3, 3] -= ABOVE_M * rotation[:, 2]
    undo = np.linalg.inv(pose_matrix(slip[3:], slip[:3]))
    here = world.arm.read(world.now).joints
    lifted, home = _lifted(world, here), np.radians(truth.preset.home_deg)
    for over in _reached(world, above @ undo, here, f"above {_named(point)}"):
        down = _reached(world, target @ undo, over, _named(point))[0]
        for by in ([], [home]):
            if world.arm.is_clear(np.array([*(lifted or [here]), *by, over, down])):
                way = np.array([*lifted, *by, over, down])
                return world.arm.place(world.now, way, SLOWLY, slip)
    raise MotionRefused(f"on every way to {_named(point)} the arm would touch something")


def _lifted(world: World, here: Array) -> list[Array]:
    """The pen drawn back from where it stands, if it can be."""
    arm = world.truth.arm
    back = arm.forward(here)
    back[:3, 3] -= ABOVE_M * back[:3, 2]
    joints, converged = ik.refine(arm, back[None], here[None])
    return [joints[0]] if converged[0] and arm.within_limits(joints)[0] else []


def _reached(world: World, target: Array, near: Array, what: str) -> Array:
    """Joints (n, 6) of the true arm with its flange at `target` (4, 4), nearest to `near` first."""
    arm = world.truth.arm
    starts = np.vstack([near, ik.random_starts(arm, STARTS, seed=0)])
    found = ik.solutions(arm, target[None], near, starts)[0]
    if not len(found):
        raise MotionRefused(f"the pen does not reach {what} with the flange turned like that")
    return found


def _named(point: Array) -> str:
    x, y, z = (1e3 * point).round(1).tolist()
    return f"({x}, {y}, {z}) mm"
