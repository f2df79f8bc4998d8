"""The pen in a run: the stroke is worked out, the pen taken over its beginning, and led along."""

from __future__ import annotations

import numpy as np

from cellctl.cell import Cell
from cellctl.drivers.base import Path, RobotState, Stroke, StrokeResult
from cellctl.geometry import Array
from cellctl.procedures import pen
from cellctl.procedures.moving import go, gone, lift_pen
from cellctl.procedures.pen import PenRig
from cellctl.procedures.spots import PlannedSpot
from cellctl.run import Run

STROKE_TIMEOUT_S = 120.0


async def over_circle(
    run: Run,
    cell: Cell,
    rig: PenRig,
    spot: PlannedSpot,
    radius: float,
    speed_m_s: float,
) -> tuple[Stroke, Path]:
    """Take the pen over the beginning of a circle of `radius` metres about a spot, if need be by
    way of where the arm has been in this run; the stroke that draws it, and the path.
    MotionRefused when none leads there."""
    return await _over(run, cell, rig, pen.circle(rig, spot.xy, radius), spot, speed_m_s)


async def over_touch(
    run: Run,
    cell: Cell,
    rig: PenRig,
    spot: PlannedSpot,
    below: float,
    speed_m_s: float,
) -> tuple[Stroke, Path]:
    """As `over_circle`, for a stroke straight down to `below` metres under the table as it is
    known."""
    ends = np.vstack([rig.over(spot.xy[None], rig.lift), rig.over(spot.xy[None], -below)])
    return await _over(run, cell, rig, pen.line(ends), spot, speed_m_s)


async def _over(
    run: Run,
    cell: Cell,
    rig: PenRig,
    tips: Array,
    spot: PlannedSpot,
    speed_m_s: float,
) -> tuple[Stroke, Path]:
    stroke: Stroke = await run.call(pen.stroke, rig, tips, spot.yaw, speed_m_s * run.speed)
    _, way = await go(run, cell, stroke.joints[:1], gone(run))
    return stroke, way


async def draw(run: Run, cell: Cell, stroke: Stroke) -> StrokeResult:
    """Follow the stroke; the pen stands over its beginning."""
    return await cell.robot.draw(stroke, timeout_s=_timeout(run))


async def touch(run: Run, cell: Cell, stroke: Stroke) -> RobotState:
    """Follow the stroke until the pen touches, and lift it again; the state at the contact."""
    contact = await cell.robot.touch(stroke, timeout_s=_timeout(run))
    await lift_pen(run, cell)
    return contact


def _timeout(run: Run) -> float:
    return STROKE_TIMEOUT_S / run.speed
