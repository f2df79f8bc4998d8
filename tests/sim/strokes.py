"""Strokes for tests: where the nominal arm has to go, and worlds in which it goes there."""

from __future__ import annotations

import numpy as np

from cellctl import ik
from cellctl.sim.grid import drawing_joints, touched_height
from cellctl.sim.motion import Limits
from cellctl.sim.world import World

JOINT_SPEED, JOINT_ACCELERATION = np.radians(40.0), np.radians(80.0)
FAST = Limits(np.full(6, JOINT_SPEED), np.full(6, JOINT_ACCELERATION), 0.25)
PUSH_M = 2e-3
ABOVE_M = 0.012
SPOT = np.array([0.10, -0.40])
RADIUS_M = 0.015


def slowly(tip_speed):
    return Limits(FAST.speed, FAST.acceleration, tip_speed)


def joints_at(truth, tips):
    """Joints (n, 6) of the nominal arm with the pen upright at world points (n, 3)."""
    start = drawing_joints(truth, tips[:1, :2], touched_height(truth))
    poses = truth.drawing_pose(tips[:, :2], 0.0)
    poses[:, 2, 3] += tips[:, 2]
    found, converged = ik.refine(truth.nominal_arm, poses, np.tile(start, (len(tips), 1)))
    assert converged.all()
    return found


def circle_tips(truth, centre=SPOT, radius=RADIUS_M, push=PUSH_M, turns=1.0):
    """Tips (n, 3) of a stroke that begins and ends above the paper, 0.8 mm apart at most."""
    height = touched_height(truth)
    angle = np.linspace(0.0, 2 * np.pi * turns, 2 + int(2 * np.pi * turns * radius / 0.8e-3))
    xy = centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    fall = np.arange(height + ABOVE_M, height - push, -0.8e-3)
    down = np.column_stack([np.tile(xy[0], (len(fall), 1)), fall])
    up = np.column_stack([np.tile(xy[-1], (len(fall), 1)), fall[::-1]])
    return np.vstack([down, np.column_stack([xy, np.full(len(xy), height - push)]), up])


def settle(world, ends):
    """Let time pass until the arm stands and rings no more."""
    world.advance(max(ends, world.now) + 0.6)


def go(world, joints, key=None):
    settle(world, world.move(np.atleast_2d(joints), FAST, key))


def draw_circle(world, key=None, speed=0.03, **circle):
    """Move above the spot, draw there; returns the joints of the stroke."""
    joints = joints_at(world.truth, circle_tips(world.truth, **circle))
    go(world, joints[0], key)
    settle(world, world.draw(joints[1:], slowly(speed), key))
    return joints


def at_work(truth):
    """A world whose arm is over the table."""
    world = World(truth)
    world.advance(1.0)
    return world


def tips_of(truth, joints):
    """Where the controller believes the pen (n, 3) at joints (n, 6)."""
    flanges = truth.nominal_arm.forward(joints)
    return flanges[:, :3, :3] @ truth.nominal_pen + flanges[:, :3, 3]


def lines_of(world, stroke):
    """What stroke number `stroke` left: table xy (n, 2) of each line, on the sheets that lie."""
    sheets = {sheet.number: sheet for sheet in world.truth.sheets}
    return [
        sheets[line.sheet].on_table(line.places[:count])
        for line, count in world.arm.pen.ink(world.now)
        if line.stroke == stroke and line.sheet in sheets
    ]
