"""The arm in a run: where it is taken to be, and how it gets somewhere."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cellctl.arms import JOINTS
from cellctl.cell import Cell
from cellctl.drivers.base import Path, RobotState, Stroke, Target
from cellctl.errors import MotionRefused
from cellctl.geometry import Array
from cellctl.procedures import pen
from cellctl.procedures.planning import reach, retrace
from cellctl.run import Run
from cellctl.store.history import Sample

MOVE_TIMEOUT_S = 120.0
LIFT_SPEED_M_S = 0.05


def gone(run: Run) -> Array:
    """Corners (n, 6) of all that the arm has gone along in this run, oldest first."""
    return ways(run.all_samples())


def ways(steps: Mapping[str, Mapping[str, Sample]]) -> Array:
    """Corners (n, 6) of the ways in the samples of all steps, oldest first; a step may have been
    left and taken up again."""
    samples = [sample for step in steps.values() for sample in step.values()]
    samples.sort(key=lambda sample: sample.n)
    corners = [corner for s in samples if "way" in s.data for corner in s.data["way"]]
    return np.array(corners).reshape(-1, JOINTS)


async def posture(run: Run, cell: Cell) -> Array:
    """Where plans start, joints (6,): the posture that this run has sent the arm to last, or where
    it stands. A resumed run, whose arm may stand somewhere else, plans as it would have."""
    corners = gone(run)
    return corners[-1] if len(corners) else (await cell.robot.read()).joints


async def go(run: Run, cell: Cell, way: Array, hubs: Array) -> tuple[RobotState, Path]:
    """Move to the end of `way` (n, 6) over an allowed path, if need be over `hubs` (m, 6) or back
    where the arm came from; the settled state and that path. A pen that is down is lifted first.
    MotionRefused when there is no path."""
    await lift_pen(run, cell)
    here = (await cell.robot.read()).joints
    path: Path | None = await run.call(reach, cell.guard, here, way, hubs)
    if path is None:
        path = await run.call(retrace, cell.guard, here, way[-1], gone(run))
    if path is None:
        degrees = ", ".join(f"{v:.1f}" for v in np.degrees(way[-1]))
        raise MotionRefused(f"no allowed path leads to joints {degrees} deg; nothing has moved")
    timeout_s = MOVE_TIMEOUT_S / run.speed
    return await cell.robot.move(Target(path, run.speed), timeout_s=timeout_s), path


async def lift_pen(run: Run, cell: Cell) -> None:
    """Take the pen straight up off the table if it stands there, as after a run that was cut
    short."""
    here = (await cell.robot.read()).joints
    if cell.guard.free(here[None])[0]:
        return
    stroke: Stroke | None = await run.call(pen.lifted, cell.guard, here, LIFT_SPEED_M_S)
    if stroke is not None:
        await run.checkpoint("the pen is lifted off the table")
        await cell.robot.draw(stroke, timeout_s=MOVE_TIMEOUT_S)
