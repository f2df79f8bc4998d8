"""The table's surface, felt with the pen: a plane, how sure it is, and its bow.

Where neither arm nor pen holder feels a contact, an operator jogs the pen to the table and says so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import table
from cellctl.calib.calibration import Calibration
from cellctl.calib.table_surface import Area, TableSurface
from cellctl.cell import Cell
from cellctl.drivers.base import RobotState
from cellctl.errors import BadInput, MotionRefused, SolveError
from cellctl.geometry import Array, Transform
from cellctl.procedures import paper, pen_motion
from cellctl.procedures.knowledge import table_plane
from cellctl.procedures.moving import posture
from cellctl.procedures.pen import PenRig, pen_rig
from cellctl.procedures.record import Record, recorded
from cellctl.procedures.spots import PlannedSpot, area, in_order
from cellctl.run import CANCEL, Procedure, Result, Run, StepCancelled
from cellctl.store.history import Sample

TOUCHES = "touches"
FEWEST = 6
DOT_M = 0.004
"""Paper that a touch takes, as a radius."""
TOUCH_SPEED_M_S = 0.02
DEEPEST = 0.9
"""Share of its travel by which a pen that feels nothing is pushed down."""
TAKEN = "the pen touches"


class MeasureTableParams(BaseModel):
    """`touches` places on the table; `seed` spreads them otherwise. `max_uncertainty_mm` is what
    the height may be uncertain by anywhere in the area, with 95 % confidence."""

    model_config = ConfigDict(extra="forbid")

    touches: int = Field(default=12, ge=6, le=60)
    seed: int = Field(default=0, ge=0)
    max_uncertainty_mm: float = Field(default=1.0, gt=0)


async def collect(run: Run, cell: Cell, params: MeasureTableParams) -> None:
    """Touch the table; the samples are in the run."""
    known = table_plane(cell.config)
    rig = pen_rig(cell.config, cell.guard, known, known.normal, await posture(run, cell))
    await run.step(TOUCHES, params.touches)
    spots = await paper.planned(run, cell, rig, params.touches, DOT_M, params.seed)
    for i, spot in enumerate(in_order(rig, spots, params.touches)):
        done = sum("T_world_flange" in sample.data for sample in run.samples().values())
        run.progress(done)
        if done >= params.touches:
            break
        key = f"touch-{i:03}"
        if paper.cut_short(run, cell, key):
            await run.sample(key, {"flaw": "cut short", **spot.to_dict()})
        elif key in run.samples():
            continue
        elif cell.config.bracket.pen.feels_contact:
            await _feel(run, cell, rig, key, spot)
        else:
            await _ask(run, cell, key, spot)


async def _feel(run: Run, cell: Cell, rig: PenRig, key: str, spot: PlannedSpot) -> None:
    await run.checkpoint(f"the pen touches the table ({key})")
    below = DEEPEST * cell.config.bracket.pen.travel_m
    async with run.taking(key):
        try:
            stroke, way = await pen_motion.over_touch(run, cell, rig, spot, below, TOUCH_SPEED_M_S)
        except MotionRefused as refused:
            await run.sample(key, {"flaw": refused.message, **spot.to_dict()})
            return
        await paper.claim(run, cell, key, spot, DOT_M)
        state = await pen_motion.touch(run, cell, stroke)
    await paper.settle(run, cell, key, spot)
    await run.sample(key, {**_touched(state, spot), "way": way.waypoints.tolist()})


async def _ask(run: Run, cell: Cell, key: str, spot: PlannedSpot) -> None:
    x, y = 1e3 * spot.xy
    answer = await run.ask(
        f"{key}: jog the pen until it just touches the table near x = {x:.0f} mm, y = {y:.0f} mm",
        [TAKEN, CANCEL],
    )
    if answer == CANCEL:
        raise StepCancelled
    state = await cell.robot.read()
    tip = np.array(cell.config.bracket.pen.tip_m)
    inked = replace(spot, xy=state.T_world_flange.apply(tip)[:2])
    await paper.claim(run, cell, key, inked, DOT_M)
    await paper.settle(run, cell, key, inked)
    await run.sample(key, _touched(state, spot))


def _touched(state: RobotState, spot: PlannedSpot) -> dict[str, Any]:
    return {
        **spot.to_dict(),
        "T_world_flange": state.T_world_flange.to_list(),
        "t": state.t,
    }


def seen(record: Record[MeasureTableParams]) -> dict[str, Array]:
    """Where the pen's tip, as the config has it, stood at each contact: (3,) in the world."""
    tip = np.array(record.config.bracket.pen.tip_m)
    samples = sorted(record.samples(TOUCHES).items())
    return {key: _tip(sample, tip) for key, sample in samples if "flaw" not in sample.data}


def _tip(sample: Sample, tip: Array) -> Array:
    try:
        pose = Transform("world", "flange", sample.data["T_world_flange"])
    except (KeyError, BadInput) as error:
        raise BadInput(f"sample {sample.key}: T_world_flange: {error}") from None
    return pose.apply(tip)


def solve(record: Record[MeasureTableParams]) -> TableSurface:
    """Pure: the surface through the touched points."""
    touched = seen(record)
    low, high = area(record.config)
    points = np.array(list(touched.values())).reshape(-1, 3)
    if len(points) < FEWEST:
        flaws = [str(s.data["flaw"]) for s in record.samples(TOUCHES).values() if "flaw" in s.data]
        raise SolveError(
            f"only {len(points)} touches could be made, {FEWEST} are needed: {'; '.join(flaws[:2])}"
        )
    return table.solve_table(points, ids=list(touched), area=Area(low, high))


def judge(surface: TableSurface, params: MeasureTableParams) -> tuple[str, tuple[str, ...]]:
    """Pass or fail, with reasons."""
    return table.judge(surface, table.TableLimits(uncertainty_mm=params.max_uncertainty_mm))


def conclude(record: Record[MeasureTableParams]) -> Result:
    """Pure: from what was recorded to the surface; with an active calibration, that one with this
    table."""
    surface = solve(record)
    _, reasons = judge(surface, record.params)
    data = {"kind": "measure-table", **told(record, surface)}
    return Result.judged(reasons, data, _calibration(record, surface))


def told(record: Record[MeasureTableParams], surface: TableSurface) -> dict[str, Any]:
    """The surface, with each touch and how far it is off."""
    touched = seen(record)
    touches = [
        {
            "key": key,
            "x": float(x),
            "y": float(y),
            "z": float(z),
            "residual_mm": float(1e3 * (z - surface.height(np.array([[x, y]]))[0])),
        }
        for key, (x, y, z) in touched.items()
    ]
    rejected = [r.to_dict() for r in surface.rejected]
    return {**surface.to_dict(), "touches": touches, "rejected": rejected}


def _calibration(record: Record[Any], surface: TableSurface) -> dict[str, Any] | None:
    if record.active is None:
        return None
    active = Calibration.from_dict(record.active, "active calibration")
    return active.on(surface).to_dict()


async def run_measure_table(run: Run, cell: Cell, params: MeasureTableParams) -> Result:
    """Collect, solve, judge."""
    await collect(run, cell, params)
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="measure-table",
    summary="Table: touches it with the pen; plane, uncertainty and bow",
    params=MeasureTableParams,
    moves=True,
    run=run_measure_table,
    conclude=conclude,
)
