"""Out of the light: the arm is moved to where neither camera nor projector sees it."""

from __future__ import annotations

import numpy as np

from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.drivers.base import Path
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, Transform
from cellctl.procedures import planning
from cellctl.procedures.sweep import go
from cellctl.run import Run

MARGIN_M = 0.05
PARK, PARKED = "park", "parked"


def beams(config: CellConfig, T_world_camera: Transform) -> list[planning.Beam]:
    """What camera and projector need free to see and light the table's lit area."""
    base = lit_area(config)
    apexes = (T_world_camera.translation, np.array(config.projector.pose.position_m))
    return [planning.Beam(apex, base) for apex in apexes]


def lit_area(config: CellConfig) -> Array:
    """Corners (4, 3) of the lit area in the world frame, from tape, throw ratio and picture."""
    pose = config.table.pose.transform("world", "table")
    distance = config.projector.pose.position_m[2] - config.table.touched_height_m
    width = distance / config.projector.throw_ratio
    height = width * config.projector.size_px[1] / config.projector.size_px[0]
    half = np.array([width, height, 0.0]) / 2
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * half
    return pose.apply(corners)


async def park(run: Run, cell: Cell, T_world_camera: Transform, key: str) -> None:
    """Leave the beams free; `key` names this time among others of the same run. MotionRefused
    when no allowed posture does."""
    await run.step(PARK)
    recorded = next((r for r in run.records(PARKED) if r["key"] == key), None)
    if recorded is None:
        here = (await cell.robot.read()).joints
        margin = MARGIN_M + cell.config.tape.position_m
        path: Path | None = await run.call(
            planning.parking, cell.guard, beams(cell.config, T_world_camera), here, margin, 0
        )
        if path is None:
            raise MotionRefused(
                "no allowed posture leaves the light free: widen the workspace box, or move "
                "camera or projector"
            )
        recorded = {"key": key, "way": path.waypoints.tolist()}
        await run.record(PARKED, **recorded)
    way = np.array(recorded["way"])
    await run.checkpoint("the arm moves out of the light")
    async with run.taking(key):
        await go(run, cell, way[-1], way)
