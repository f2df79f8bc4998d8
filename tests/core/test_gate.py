"""The door to the arm: shut for whoever is not the active run, whatever a procedure does."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest
import structlog

from cellctl.drivers.base import Path as Joints
from cellctl.drivers.base import Target
from cellctl.engine.active_run import ActiveRun
from cellctl.errors import DeviceFault, NotEnabled
from cellctl.gate import Gate
from cellctl.guarded_robot import GuardedRobot
from cellctl.messages import PromoteRequest
from cellctl.motion import guard_of
from cellctl.permission import Permission, enable
from cellctl.run import Procedure, Result
from tests import cells
from tests.core.toy import PROCEDURES, ToyParams, ToyRobot, bench
from tests.postures import ABOVE

SHUT = "only moves for a run that is active"


def to(*joints: float) -> Target:
    return Target(Joints(np.array([joints])), 1.0)


HERE, THERE = to(*[0.0] * 6), to(*[0.5] * 6)


class Tries:
    """What came of a procedure's attempts to move."""

    def __init__(self):
        self.outcomes: list[str] = []

    async def move(self, robot, target=THERE):
        try:
            await robot.move(target, timeout_s=5)
        except NotEnabled as error:
            self.outcomes.append(error.message)
        else:
            self.outcomes.append("moved")


def procedures(run, *, moves=True):
    return [*PROCEDURES, Procedure("tries", "Tries to move", ToyParams, moves=moves, run=run)]


async def test_a_cancelled_procedure_cannot_move_in_its_cleanup(tmp_path):
    tries = Tries()

    async def deaf(run, cell, params):
        await tries.move(cell.robot)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(60)
        await tries.move(cell.robot, HERE)
        return Result("pass")

    async with bench(tmp_path, procedures=procedures(deaf)) as toy:
        run_id = await toy.start("tries")
        await toy.until(lambda: tries.outcomes)
        await toy.cancel()
        assert (await toy.ended(run_id)).status == "cancelled"
        assert toy.robot.moves == 1
    assert tries.outcomes[0] == "moved"
    assert SHUT in tries.outcomes[1]


async def test_a_task_that_outlives_its_run_cannot_move_then_or_in_a_later_run(tmp_path):
    tries, left, go = Tries(), [], asyncio.Event()

    async def straggler(robot):
        for _ in range(2):
            await go.wait()
            go.clear()
            await tries.move(robot)

    async def careless(run, cell, params):
        left.append(asyncio.create_task(straggler(cell.robot)))
        return Result("pass")

    async with bench(tmp_path, procedures=procedures(careless)) as toy:
        await toy.ended(await toy.start("tries"))
        go.set()
        await toy.until(lambda: tries.outcomes)
        await toy.start("survey", "request-2", views=1000)
        await toy.until(lambda: toy.robot.moving)
        go.set()
        await asyncio.gather(*left)
        assert len(tries.outcomes) == 2
        assert all(SHUT in outcome for outcome in tries.outcomes)


async def test_a_procedure_that_hangs_on_is_shut_out(tmp_path):
    """It swallows every cancellation; the fault says so, and it moves nothing meanwhile."""
    tries, done = Tries(), asyncio.Event()

    async def stubborn(run, cell, params):
        while not done.is_set():
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.sleep(0.01)
            await tries.move(cell.robot)
        return Result("pass")

    async with bench(tmp_path, procedures=procedures(stubborn)) as toy:
        run_id = await toy.start("tries")
        await toy.until(lambda: tries.outcomes)
        await toy.cancel()
        assert (await toy.ended(run_id)).status == "cancelled"
        assert "does not end when it is told to" in str(toy.engine.state().fault)
        moves, hung = toy.robot.moves, toy.engine._hung
        assert hung is not None
        tries.outcomes.clear()
        await toy.until(lambda: len(tries.outcomes) > 2)
        assert all(SHUT in outcome for outcome in tries.outcomes)
        assert toy.robot.moves == moves
        done.set()
        await asyncio.wait([hung])


async def test_a_procedure_that_says_it_does_not_move_cannot(tmp_path):
    tries = Tries()

    async def sly(run, cell, params):
        await tries.move(cell.robot)
        return Result("pass")

    async with bench(tmp_path, procedures=procedures(sly, moves=False)) as toy:
        await toy.ended(await toy.start("tries"))
        assert toy.robot.moves == 0
    assert SHUT in tries.outcomes[0]


async def test_the_permission_may_end_while_the_robot_is_asked(tmp_path, monkeypatch):
    """Between the first check and the motion there are a read and a check by the controller."""
    enable(tmp_path, 3600)
    gate = Gate(Permission(tmp_path))
    robot = ToyRobot()
    robot.joints = ABOVE.copy()
    check = robot.check

    async def slow(path):
        await check(path)
        gate.shut()

    monkeypatch.setattr(robot, "check", slow)
    config = cells.config()
    guarded = GuardedRobot(robot, guard_of(config), config, gate.require)
    gate.admit()
    with pytest.raises(NotEnabled, match=SHUT):
        await guarded.move(to(ABOVE[0] + 0.05, *ABOVE[1:]), timeout_s=5)
    assert robot.moves == 0


# -- the arm is stopped


async def test_shutdown_stops_the_arm_before_a_command_that_hangs(tmp_path, monkeypatch):
    async with bench(tmp_path) as toy:
        disk = asyncio.Event()

        async def slow_disk(*_, **__):
            await disk.wait()

        monkeypatch.setattr(toy.engine, "_promote", slow_disk)
        await toy.start("survey", views=1000)
        await toy.until(lambda: toy.robot.moving)
        promotion = asyncio.create_task(toy.engine.promote(PromoteRequest(calibration_id="cal-1")))
        await asyncio.sleep(0)
        shutdown = asyncio.create_task(toy.engine.shutdown())
        await toy.until(lambda: toy.robot.stops)
        assert not promotion.done()
        assert not toy.robot.moving
        disk.set()
        await asyncio.gather(promotion, shutdown)


@pytest.mark.parametrize("stop_fails", [False, True])
async def test_a_defect_of_the_supervision_stops_the_arm_and_closes_the_journal(
    tmp_path, monkeypatch, stop_fails
):
    async with bench(tmp_path) as toy:

        async def defective(self):
            self._task = asyncio.create_task(self._perform())
            await toy.until(lambda: toy.robot.moving)
            toy.robot.stop_fails = stop_fails
            raise RuntimeError("a loose screw")

        monkeypatch.setattr(ActiveRun, "_outcome", defective)
        with structlog.testing.capture_logs():
            run_id = await toy.start("survey", views=1000)
            assert toy.engine._active is not None
            journal = toy.engine._active.record._journal
            info = await toy.ended(run_id)
        assert (info.status, info.error) == ("interrupted", "RuntimeError('a loose screw')")
        assert toy.robot.stops == [False]
        assert not toy.robot.moving
        assert journal._descriptor == -1
        fault = str(toy.engine.state().fault)
        assert "a defect of the program" in fault
        assert ("the arm could not be stopped" in fault) == stop_fails
        with pytest.raises(DeviceFault):
            await toy.start("survey", "request-2")
        monkeypatch.undo()
        toy.robot.stop_fails = False
        await toy.ack()
        await toy.resume(run_id)
        await toy.cancel()
        await toy.phase("idle")
