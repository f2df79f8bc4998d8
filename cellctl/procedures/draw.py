"""Circles: the arm draws them with the pen, the camera finds them.

Round by round, so that what goes wrong is noticed while there is paper left: after each round the
arm leaves the light and a picture is taken. A circle that was cut short is void, and a spare spot
takes its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib.calibration import Calibration
from cellctl.calib.challenger import expected_error_mm
from cellctl.calib.design import enough
from cellctl.calib.refine_fit import Marks
from cellctl.calib.table_surface import Area
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.drivers.base import StrokeResult
from cellctl.errors import BadInput, MotionRefused, SolveError
from cellctl.geometry import Array
from cellctl.motion import Guard
from cellctl.procedures import drawn, paper, pen_motion, pictures
from cellctl.procedures.moving import posture
from cellctl.procedures.pen import PenRig, pen_rig
from cellctl.procedures.record import Record, recorded
from cellctl.procedures.spots import PlannedSpot, area, in_order
from cellctl.run import Procedure, Result, Run

CIRCLES = "circles"
RADIUS_PX = 12.0
"""Of a circle in the camera's picture, where nobody says otherwise."""
MEASURED = 24
"""Measured postures that are journalled of a circle."""


class DrawParams(BaseModel):
    """`spots` circles a round, in `rounds` rounds, all on places of their own. `radius_mm`: 12
    camera pixels when left out. `search_mm`: how far from its place a circle is looked for.
    `wanted_mm`: draw no further round when the map's predicted error over the area is not above
    it, or no longer falls; when left out, all rounds are drawn."""

    model_config = ConfigDict(extra="forbid")

    spots: int = Field(default=12, ge=4, le=100)
    rounds: int = Field(default=5, ge=1, le=20)
    radius_mm: float | None = Field(default=None, gt=2, le=200)
    pen_speed_mm_s: float = Field(default=60.0, gt=0, le=500)
    search_mm: float = Field(default=15.0, gt=0, le=100)
    wanted_mm: float | None = Field(default=None, gt=0, le=10)
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True, eq=False)
class Drawing:
    """What a drawing is made with: the rig, circles of `radius`, metres, at `speed_m_s`, `count`
    good ones in each of `rounds`."""

    rig: PenRig
    radius: float
    speed_m_s: float
    count: int
    rounds: int
    seed: int


def drawing_of(
    config: CellConfig, guard: Guard, base: Calibration, params: DrawParams, here: Array
) -> Drawing:
    """The drawing that `params` ask for on the table of `base`. SolveError where the table is not
    known well enough for the pen."""
    surface = base.surface
    if surface is None:
        raise SolveError("the table has not been touched: run measure-table first")
    travel = config.bracket.pen.travel_m
    if surface.uncertainty_m + surface.bow_m > travel / 2:
        raise SolveError(
            f"the table is uncertain by {1e3 * surface.uncertainty_m:.1f} mm and bows by "
            f"{1e3 * surface.bow_m:.1f} mm, together more than half of the {1e3 * travel:.1f} mm "
            "that the pen holder gives way: measure more touches, or flatten the table"
        )
    rig = pen_rig(config, guard, surface, surface.plane.normal, here)
    return Drawing(
        rig=rig,
        radius=radius_of(base, params.radius_mm),
        speed_m_s=1e-3 * params.pen_speed_mm_s,
        count=params.spots,
        rounds=params.rounds,
        seed=params.seed,
    )


def radius_of(base: Calibration, radius_mm: float | None) -> float:
    """In metres; RADIUS_PX in the picture, to whole millimetres, where it is not given."""
    if radius_mm is not None:
        return 1e-3 * radius_mm
    depth = abs((base.table.point - base.T_world_camera.translation) @ base.table.normal)
    return float(np.ceil(1e3 * RADIUS_PX * depth / base.camera.K[0, 0])) * 1e-3


async def collect(run: Run, cell: Cell, params: DrawParams, base: Calibration) -> None:
    """Draw all rounds, with a picture before the first and after each."""
    drawing = drawing_of(cell.config, cell.guard, base, params, await posture(run, cell))
    await pictures.blank(run, cell, base)
    sight = await pictures.sight(run, base)
    await run.step(CIRCLES, drawing.count * drawing.rounds)
    total = drawing.count * drawing.rounds
    spots = await paper.planned(
        run, cell, drawing.rig, total, drawing.radius, drawing.seed, sight=sight, telling=True
    )
    search = 1e-3 * params.search_mm
    place, predicted = 0, list[float]()
    for number in range(drawing.rounds):
        place = await draw_round(run, cell, drawing, spots, place, number)
        circles = drawn.circles(run.samples(CIRCLES))
        key = f"after-{number}"
        await pictures.of_circles(run, cell, base, key, circles, search)
        so_far = seen(recorded(run, cell.config, params), base)
        if trouble := await run.call(drawn.trouble, so_far, number, base):
            await run.record("stopped", round=number, reason=trouble)
            break
        if params.wanted_mm is not None:
            predicted.append(await run.call(predicted_mm, so_far, base, cell.config))
            if reason := enough(predicted, params.wanted_mm):
                await run.record("enough", round=number, reason=reason)
                break


def predicted_mm(found: drawn.Drawn, base: Calibration, config: CellConfig) -> float:
    """Pure: the error of the map over the area that the circles found so far let expect, in mm;
    not-a-number while they are too few to tell."""
    circles = Marks.of(found.marks(base.camera), base)
    return expected_error_mm(circles, Area(*area(config)).grid())


async def draw_round(
    run: Run, cell: Cell, drawing: Drawing, spots: list[PlannedSpot], place: int, number: int
) -> int:
    """Draw a round from the spot number `place` on; the number of the next spot."""
    await run.step(CIRCLES, drawing.count * drawing.rounds)
    order = in_order(drawing.rig, spots, drawing.count)
    good = 0
    while good < drawing.count:
        if place >= len(spots):
            raise SolveError(f"too many circles are void: the spots ran out in round {number + 1}")
        key = f"circle-{place:03}"
        await _draw_once(run, cell, drawing, key, order[place], number)
        good += run.samples()[key].data["state"] == "drawn"
        run.progress(sum(s.data["state"] == "drawn" for s in run.samples().values()))
        place += 1
    return place


async def _draw_once(
    run: Run, cell: Cell, drawing: Drawing, key: str, spot: PlannedSpot, number: int
) -> None:
    """Draw the circle `key` and journal it. One that was begun before a crash is void; one that
    the guard refuses is journalled and passed over."""
    if key in run.samples():
        return
    facts = {**spot.to_dict(), "round": number, "radius_m": drawing.radius}
    if paper.cut_short(run, cell, key):
        await run.sample(key, {**facts, "state": "void", "flaw": "cut short"})
        return
    await run.checkpoint(f"the arm draws {key}")
    async with run.taking(key):
        try:
            stroke, way = await pen_motion.over_circle(
                run, cell, drawing.rig, spot, drawing.radius, drawing.speed_m_s
            )
        except MotionRefused as refused:
            await run.sample(key, {**facts, "state": "void", "flaw": refused.message})
            return
        await paper.claim(run, cell, key, spot, drawing.radius)
        result = await pen_motion.draw(run, cell, stroke)
    await paper.settle(run, cell, key, spot)
    way_data = {"way": np.vstack([way.waypoints, result.state.joints]).tolist()}
    measured = _measured(drawing.rig, result)
    await run.sample(key, {**facts, "state": "drawn", **way_data, "measured": measured})


def _measured(rig: PenRig, result: StrokeResult) -> dict[str, Any]:
    """The circle that the tip has followed as the arm measured it: centre (2,) and radius, metres,
    and some of the measured postures."""
    assert rig.guard.pen is not None
    tips = rig.guard.pen.tips(rig.guard.arm.forward(result.joints))
    low = tips[:, 2] - rig.surface.height(tips[:, :2]) < 0.0
    if np.count_nonzero(low) < MEASURED:
        raise BadInput("the robot reported too few postures of the circle while it was drawn")
    x, y = tips[low, 0], tips[low, 1]
    A = np.column_stack([2 * x, 2 * y, np.ones(len(x))])
    (cx, cy, c), *_ = np.linalg.lstsq(A, x**2 + y**2, rcond=None)
    some = np.linspace(0, len(x) - 1, MEASURED).astype(int)
    return {
        "xy": [float(cx), float(cy)],
        "radius_m": float(np.sqrt(c + cx**2 + cy**2)),
        "joints": result.joints[low][some].tolist(),
        "t": result.t[low][some].tolist(),
    }


def seen(record: Record[DrawParams], base: Calibration) -> drawn.Drawn:
    """What was drawn and found."""
    return drawn.seen(record, CIRCLES, base, 1e-3 * record.params.search_mm)


def conclude(record: Record[DrawParams]) -> Result:
    """Pure: from what was recorded to the circles and their faults."""
    base = active_of(record.active)
    found = seen(record, base)
    reasons = drawn.faults(found, base)
    return Result.judged(reasons, {"kind": "draw", **found.to_dict()})


def active_of(active: Any) -> Calibration:
    """The active calibration; SolveError when there is none."""
    if active is None:
        raise SolveError(
            "there is no active calibration to find the circles with: run full, or promote one"
        )
    return Calibration.from_dict(active, "active calibration")


async def run_draw(run: Run, cell: Cell, params: DrawParams) -> Result:
    """Collect, judge."""
    await collect(run, cell, params, active_of(run.calibration))
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="draw",
    summary="Circles: draws them with the pen and finds them with the camera",
    params=DrawParams,
    moves=True,
    run=run_draw,
    conclude=conclude,
)
