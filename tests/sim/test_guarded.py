"""The guarded robot on a simulated arm: what is not allowed moves nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.errors import MotionRefused, NotEnabled
from cellctl.guarded_robot import GuardedRobot
from cellctl.motion import guard_of
from cellctl.sim.link import Link
from tests.postures import pen_at
from tests.sim.worlds import config, devices, to, world

GUARD = guard_of(config())
STEP = np.radians([3.0, 0, 0, 0, 0, 0])


def allowed() -> None:
    """The permission of a cell that is enabled."""


def forbidden() -> None:
    raise NotEnabled("motion is not enabled")


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory):
    with world(tmp_path_factory.mktemp("guarded")) as running:
        yield running


async def joints(cell):
    return (await cell.robot.read()).joints


async def moves_nothing(cell, robot, target, error, match):
    before = await cell.robot.read()
    with pytest.raises(error, match=match):
        await robot.move(target, timeout_s=30)
    after = await cell.robot.read()
    assert after.t == before.t
    assert np.array_equal(after.joints, before.joints)


async def test_without_permission_nothing_moves(endpoint):
    async with devices(endpoint) as cell:
        robot = GuardedRobot(cell.robot, GUARD, config(), forbidden)
        target = to(await joints(cell) + STEP)
        await moves_nothing(cell, robot, target, NotEnabled, "not enabled")


async def test_a_path_through_the_table_moves_nothing(endpoint):
    async with devices(endpoint) as cell:
        robot = GuardedRobot(cell.robot, GUARD, config(), allowed)
        here = await joints(cell)
        below = pen_at(GUARD, 0.0, -0.44, -0.02)[0]
        await moves_nothing(cell, robot, to(below, here), MotionRefused, "refused at")


async def test_another_arm_than_the_config_says_moves_nothing(endpoint):
    async with devices(endpoint) as cell:
        document = config()
        other = document.model_copy(
            update={"robot": document.robot.model_copy(update={"arm": "irb4600-60/2.05"})}
        )
        robot = GuardedRobot(cell.robot, guard_of(other), other, allowed)
        target = to(await joints(cell) + STEP)
        await moves_nothing(cell, robot, target, MotionRefused, "another arm")


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.01, np.nan])
async def test_a_speed_that_is_none_moves_nothing(endpoint, speed):
    async with devices(endpoint) as cell:
        robot = GuardedRobot(cell.robot, GUARD, config(), allowed)
        target = to(await joints(cell) + STEP, speed=speed)
        await moves_nothing(cell, robot, target, MotionRefused, "speed fraction")


async def test_an_arm_that_still_moves_is_stopped_first(endpoint):
    """As a resumed run finds it: the link is new, and the arm under way."""
    async with devices(endpoint) as cell:
        robot = GuardedRobot(cell.robot, GUARD, config(), allowed)
        here = await joints(cell)
        other = Link("somebody", endpoint.cell)
        await other.request(
            "robot.move",
            waypoints=[(here + 5 * STEP).tolist()],
            joint_speed_rad_s=0.2,
            joint_acceleration_rad_s2=1.4,
            tool_speed_m_s=0.5,
        )
        await other.close()
        state = await robot.move(to(here), timeout_s=30)
        assert np.abs(state.joints - here).max() < 1e-3


async def test_the_fastest_point_keeps_the_configured_speed(endpoint):
    """However fast the joints might turn: the guard's own spheres, not only the flange."""
    async with devices(endpoint) as cell:
        document = config()
        slow = document.model_copy(
            update={"robot": document.robot.model_copy(update={"tcp_speed_m_s": 0.05})}
        )
        robot = GuardedRobot(cell.robot, GUARD, slow, allowed)
        before = await cell.robot.read()
        target = to(before.joints + STEP)
        state = await robot.move(target, timeout_s=60)
        centres, _ = GUARD.spheres(GUARD.sample(before.joints, target.path))
        way = np.linalg.norm(np.diff(centres, axis=0), axis=2).sum(axis=0).max()
        assert state.t - before.t >= way / 0.05
        back = replace(target, path=to(before.joints).path)
        await robot.move(back, timeout_s=60)
