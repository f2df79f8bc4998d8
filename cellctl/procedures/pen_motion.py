"""The pen in a run: over a spot, down, along, and up again."""

from __future__ import annotations

import numpy as np

from cellctl.cell import Cell
from cellctl.drivers.base import Path, RobotState, StrokeResult
from cellctl.geometry import Array
from cellctl.procedures import pen
from cellctl.procedures.moving import go, lift_pen
from cellctl.procedures.pen import PenRig
from cellctl.procedures.spots import PlannedSpot
from cellctl.run import Run

STROKE_TIMEOUT_S = 120.0


async def over(run: Run, cell: Cell, spot: PlannedSpot, hubs: Array) -> tuple[RobotState, Path]:
    """Move the pen over a spot; the settled state and the path. MotionRefused when none leads
    there."""
    return await go(run, cell, spot.joints[None], hubs)


async def draw(run: Run, cell: Cell, rig: PenRig, spot: PlannedSpot, radius: float,
               speed_m_s: float) -> StrokeResult:  # fmt: skip
    """Draw a circle of `radius` metres about a spot; the pen stands over its beginning."""
    tips = pen.circle(rig, spot.xy, radius)
    stroke = await run.call(pen.stroke, rig, tips, spot.yaw, speed_m_s * run.speed)
    return await cell.robot.draw(stroke, timeout_s=_timeout(run))


async def touch(run: Run, cell: Cell, rig: PenRig, spot: PlannedSpot, speed_m_s: float,
                below: float) -> RobotState:  # fmt: skip
    """Lower the pen until it touches, not further than `below` metres under the table as it is
    known, and lift it again; the state at the contact."""
    tips = pen.line(np.vstack([rig.over(spot.xy[None], rig.lift), rig.over(spot.xy[None], -below)]))
    stroke = await run.call(pen.stroke, rig, tips, spot.yaw, speed_m_s * run.speed)
    contact = await cell.robot.touch(stroke, timeout_s=_timeout(run))
    await lift_pen(run, cell)
    return contact


def _timeout(run: Run) -> float:
    return STROKE_TIMEOUT_S / run.speed
