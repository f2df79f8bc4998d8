"""The correction that drawn circles ask for, from a drawing that was made before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import marks, refine
from cellctl.calib.calibration import Calibration
from cellctl.calib.refine_fit import Mark
from cellctl.calib.refine_result import RefineResult
from cellctl.cell import Cell
from cellctl.errors import BadInput
from cellctl.procedures import drawn
from cellctl.procedures.draw import active_of
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run
from cellctl.store.run_folder import RecordedRun, read_run

MARKS, TAKEN = "marks", "marks"
DRAWINGS = {"draw": "", "full": "draw/"}
"""Procedures that draw, and the scope in which they do."""


class RefineParams(BaseModel):
    """`drawing`: the run that drew the circles; the newest one of this cell when left out."""

    model_config = ConfigDict(extra="forbid")

    drawing: str | None = None
    max_held_out_mm: float = Field(default=1.0, gt=0)
    max_tcp_off_mm: float = Field(default=3.0, gt=0)


def solve(
    circles: list[Mark], base: Calibration, adjust: refine.Adjust | None = None
) -> RefineResult:
    """Pure: the correction and the pen's offset; `adjust` makes the joint adjustment of the run a
    candidate. SolveError when the circles contradict each other."""
    covariance = base.quality.get("hand_eye_covariance")
    pose = None if covariance is None else np.array(covariance)[:6, :6]
    return refine.solve_refine(circles, base, pose_covariance=pose, adjust=adjust)


def slipped(circles: list[Mark], base: Calibration) -> list[str]:
    """Where the pen moved in its holder while the circles (in the order of drawing) were drawn."""
    return list(marks.slip_reasons(marks.slips(circles, base)))


def judge(result: RefineResult, params: RefineParams, slips: list[str]) -> list[str]:
    """Why it fails; empty when it passes. A pen that slipped (`slips`) looks like one that stands
    off, and is not blamed for both."""
    reasons = list(slips)
    if not slips:
        limit = params.max_tcp_off_mm
        reasons += marks.tcp_reasons(result.tcp_mm, result.tcp_covariance_mm2, limit)
    error = result.errors["leave_one_out"].mm
    if not error <= params.max_held_out_mm:
        reasons.append(
            f"held-out error of the circles {error:.2f} mm, over the limit of "
            f"{params.max_held_out_mm} mm"
        )
    return reasons


def refined(base: Calibration, result: RefineResult) -> Calibration:
    """`base` with the correction, and with what was learnt of the pen."""
    quality = {
        **base.quality,
        "tcp_off_mm": [float(v) for v in result.tcp_mm],
        "mark_sigma_mm": float(result.mark_sigma_mm),
        "mark_freedom": float(result.mark_freedom),
    }
    return replace(result.calibration(base), quality=quality)


def result_data(result: RefineResult) -> dict[str, Any]:
    """The JSON form, candidates as rows of figures."""
    data = result.to_dict()
    return {**data, "candidates": {c.name: _row(c.to_dict()) for c in result.candidates}}


def _row(candidate: Mapping[str, Any]) -> dict[str, Any]:
    errors = candidate["errors"]
    row: dict[str, Any] = {"allowed": candidate["allowed"], "note": candidate["why_not"]}
    for name, short in (
        ("training", "training"),
        ("leave_one_out", "loo"),
        ("leave_row_out", "row"),
    ):
        for unit in ("px", "mm"):
            row[f"{short}_{unit}"] = errors[name][unit] if name in errors else None
    return {**row, "condition": candidate["condition"]}


async def collect(run: Run, cell: Cell, params: RefineParams) -> None:
    """Copy the circles of the drawing into this run, so that it stands alone."""
    await run.step(MARKS)
    if TAKEN in run.samples():
        return
    found = await run.call(_drawing, run.directory, params.drawing, cell.config.cell.id)
    await run.sample(TAKEN, found)


def _drawing(directory: Path, wanted: str | None, cell: str) -> dict[str, Any]:
    """The circles of a run beside `directory`, as they were journalled."""
    if wanted is not None:
        drawing = read_run(directory.parent / wanted)
    else:
        drawing = _newest(directory, cell)
    prefix = DRAWINGS.get(drawing.header.procedure)
    if prefix is None:
        raise BadInput(
            f"run {drawing.header.run_id} drew nothing: it is a {drawing.header.procedure}"
        )
    steps = drawing.history.steps()
    return {
        "drawing": drawing.header.run_id,
        "circles": {k: dict(s.data) for k, s in steps.get(f"{prefix}circles", {}).items()},
        "pictures": {k: dict(s.data) for k, s in steps.get(f"{prefix}pictures", {}).items()},
    }


def _newest(directory: Path, cell: str) -> RecordedRun:
    for path in sorted(directory.parent.iterdir(), reverse=True):
        if path == directory or not (path / "run.json").exists():
            continue
        found = read_run(path)
        drew = found.header.procedure in DRAWINGS and found.header.cell == cell
        if drew and found.standing.status == "done":
            return found
    raise BadInput("no run of this cell has drawn circles yet: run draw first")


def conclude(record: Record[RefineParams]) -> Result:
    """Pure: from the circles to the active calibration with their correction."""
    base = active_of(record.active)
    circles = _marks(record, base)
    result = solve(circles, base)
    reasons = judge(result, record.params, slipped(circles, base))
    data = {"kind": "refine", **result_data(result)}
    return Result.judged(reasons, data, refined(base, result).to_dict())


def _marks(record: Record[RefineParams], base: Calibration) -> list[Mark]:
    data = record.samples(MARKS)[TAKEN].data
    return drawn.of_journal(data["circles"], data["pictures"]).marks(base.camera)


async def run_refine(run: Run, cell: Cell, params: RefineParams) -> Result:
    """Collect, solve, judge."""
    await collect(run, cell, params)
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="refine",
    summary="Correction: fits what circles that were drawn before ask for",
    params=RefineParams,
    moves=False,
    run=run_refine,
    conclude=conclude,
)
