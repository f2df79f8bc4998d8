"""Everything that there is, one after the other: intrinsic, hand-eye, projector, measure-table,
draw, refine, evaluate, and the verdict of all together.

Each part is the procedure that also runs alone, in a scope of its own; what one part found out is
what the next one starts from. A pen or a sheet that fails ends the drawing, and is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.joint.result import JointResult
from cellctl.calib.refine_fit import Mark
from cellctl.calib.refine_result import RefineResult
from cellctl.calib.stages import Stage
from cellctl.calib.table_surface import TableSurface
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.errors import SolveError
from cellctl.procedures import (
    accuracy,
    comparison,
    draw,
    drawn,
    evaluate,
    hand_eye,
    intrinsic,
    measure_table,
    optical,
    projector,
    refine,
)
from cellctl.procedures.belief import Belief
from cellctl.procedures.draw import DrawParams
from cellctl.procedures.evaluate import EvaluateParams, Judged, Noise
from cellctl.procedures.knowledge import Knowledge, known
from cellctl.procedures.measure_table import MeasureTableParams
from cellctl.procedures.optical import HAND_EYE, INTRINSIC, PROJECTOR, Optical, OpticalParams
from cellctl.procedures.pictures import PICTURES
from cellctl.procedures.record import Record, recorded
from cellctl.procedures.refine import RefineParams
from cellctl.run import Procedure, Result, Run

TABLE, DRAW, REFINE, EVALUATE = "measure-table", "draw", "refine", "evaluate"
BASE, REFINED, ACCURACY = "base", "refined", "accuracy"


class FullParams(OpticalParams):
    """The parameters of the parts."""

    measure_table: MeasureTableParams = MeasureTableParams()
    draw: DrawParams = DrawParams()
    refine: RefineParams = RefineParams()
    evaluate: EvaluateParams = EvaluateParams()


async def run_full(run: Run, cell: Cell, params: FullParams) -> Result:
    """Collect all, then solve and judge all together."""
    await _look(run, cell, params)
    await measure_table.collect(run.scope(TABLE), cell, params.measure_table)
    base = await _kept(run, BASE, base_of, _record(run, cell, params))
    if base is not None:
        await draw.collect(run.scope(DRAW), cell, params.draw, base)
        refined = await _kept(run, REFINED, refined_of, _record(run, cell, params), base)
        if refined is not None:
            await evaluate.collect(run.scope(EVALUATE), cell, params.evaluate, refined)
    return await run.call(conclude, _record(run, cell, params))


async def _look(run: Run, cell: Cell, params: FullParams) -> None:
    """Boards and projected markers."""
    start = known(cell.config, run.calibration)
    await projector.look_before(run.scope(PROJECTOR), cell, params.projector, start)
    belief = start.belief(cell.config, intrinsic.BOARD)
    belief = await intrinsic.collect(run.scope(INTRINSIC), cell, params.intrinsic, belief)
    belief = await run.call(_next_belief, _record(run, cell, params), start, belief)
    belief = await hand_eye.collect(run.scope(HAND_EYE), cell, params.hand_eye, belief)
    boards = {hand_eye.BOARD: belief.T_flange_board}
    found = Knowledge(belief.camera, belief.T_world_camera, calibrated=True, boards=boards)
    await projector.collect(run.scope(PROJECTOR), cell, params.projector, found)


def _record(run: Run, cell: Cell, params: FullParams) -> Record[FullParams]:
    return recorded(run, cell.config, params)


async def _kept(run: Run, name: str, solve: Any, *args: Any) -> Calibration | None:
    """What `solve` finds, once a run: a resumed run goes on with the same. None when that is no
    calibration to go on with."""
    found = run.recall(name)
    if found is None:
        calibration: Calibration | None = await run.call(solve, *args)
        found = {"calibration": calibration.to_dict() if calibration else None}
        await run.record(name, **found)
    return Calibration.from_dict(found["calibration"], name) if found["calibration"] else None


def _next_belief(record: Record[FullParams], start: Knowledge, belief: Belief) -> Belief:
    """What the search for the marker board starts from: the calibrated camera, where the
    checkerboard showed it to hang, and the marker board's pose as it was known."""
    checker = intrinsic.seen(record.scoped(INTRINSIC, record.params.intrinsic))
    camera = intrinsic.solve(checker).camera
    belief = replace(belief, camera=camera).updated(checker.views)
    found = Knowledge(camera, belief.T_world_camera, calibrated=True, boards=start.boards)
    return found.belief(record.config, hand_eye.BOARD)


def base_of(record: Record[FullParams]) -> Calibration | None:
    """Pure: the calibration with which circles are drawn and found; None when the parts before
    have failed already, and paper would be wasted."""
    try:
        seen = optical.solve(record, record.params)
    except SolveError:  # the end of the run tells why
        return None
    table = _table(record)
    failed = any(seen.judged(record.params, record.config).values())
    if failed or measure_table.judge(table, record.params.measure_table)[1]:
        return None
    return seen.calibration(table.plane).on(table)


def refined_of(record: Record[FullParams], base: Calibration) -> Calibration | None:
    """Pure: the calibration that is evaluated; None when what was drawn has failed already."""
    ink = _ink(record, base, optical.solve(record, record.params))
    return None if ink.reasons or ink.result is None else refine.refined(base, ink.result)


def _table(record: Record[FullParams]) -> TableSurface:
    return measure_table.solve(record.scoped(TABLE, record.params.measure_table))


@dataclass(frozen=True, eq=False)
class Ink:
    """What was drawn, and what came of it: `reasons` against the drawing, and the correction,
    None when the circles do not give one."""

    drawn: drawn.Drawn
    faults: list[str]
    refusals: list[str]
    result: RefineResult | None

    @property
    def reasons(self) -> list[str]:
        return [*self.faults, *self.refusals]


def _ink(record: Record[FullParams], base: Calibration, seen: Optical) -> Ink:
    """Pure: circles, their faults, and the correction."""
    found = draw.seen(record.scoped(DRAW, record.params.draw), base)
    faults = drawn.faults(found, base)
    marks = found.marks(base.camera)
    slips = refine.slipped(marks, base)
    touches = measure_table.seen(record.scoped(TABLE, record.params.measure_table))
    held = accuracy.held_boards(record.scoped(PROJECTOR, record.params.projector))
    adjust = accuracy.adjusting(seen, np.array(list(touches.values())), held, base)
    try:
        result = refine.solve(marks, base, adjust)
    except SolveError as error:
        return Ink(found, faults, slips or [error.message], None)
    return Ink(found, faults, refine.judge(result, record.params.refine, slips), result)


def conclude(record: Record[FullParams]) -> Result:
    """Pure: from what was recorded to all results, the tables and the calibration."""
    params = record.params
    try:
        seen = optical.solve(record, params)
    except SolveError as error:
        return Result.unsolved("full", error)
    table = _table(record)
    stages = seen.stages(record.config)
    reasons = dict(seen.judged(params, record.config))
    reasons[TABLE] = measure_table.judge(table, params.measure_table)[1]
    best = seen.calibration(table.plane).on(table)
    data: dict[str, Any] = {
        **seen.data(),
        TABLE: measure_table.told(record.scoped(TABLE, params.measure_table), table),
    }
    if params.projector.held:
        light = record.scoped(PROJECTOR, params.projector)
        data[PROJECTOR]["full_model"], why = projector.full_model(light, best, seen.shown)
        reasons[PROJECTOR] = (*reasons[PROJECTOR], *why)
    if record.scoped(DRAW, params.draw).samples(draw.CIRCLES):
        best = _prove(record, best, seen, stages, data, reasons)
    for part, why in reasons.items():
        verdict = "fail" if why else "pass"
        data[part] = {"verdict": verdict, "reasons": list(why), **data.get(part, {})}
    every = [f"{part}: {reason}" for part, why in reasons.items() for reason in why]
    data = {"kind": "full", **data, "stages": [_stage(stage) for stage in stages]}
    return Result.judged(every, data, best.to_dict())


def _prove(
    record: Record[FullParams],
    base: Calibration,
    seen: Optical,
    stages: list[Stage],
    data: dict[str, Any],
    reasons: dict[str, tuple[str, ...]],
) -> Calibration:
    """What the circles say, into `data` and `reasons`; the calibration with their correction."""
    ink = _ink(record, base, seen)
    data[DRAW], reasons[DRAW] = ink.drawn.to_dict(), tuple(ink.faults)
    reasons[REFINE] = tuple(ink.refusals)
    if ink.result is None:
        return base
    best = refine.refined(base, ink.result)
    data[REFINE] = refine.result_data(ink.result)
    judged, why = _evaluated(record, best, ink.result)
    reasons[EVALUATE] = why if not ink.reasons else ()
    if judged is not None:
        data[EVALUATE] = judged.to_dict()
        best = replace(best, quality={**best.quality, **judged.quality()})
    marks = ink.drawn.marks(base.camera)
    if ink.result.joint is not None:
        data[ACCURACY] = _accuracy(record.config, ink.result.joint, marks, judged, base, best)
    circles = comparison.Circles(marks, judged, best, ink.result.tcp_mm)
    data.update(comparison.table(stages, circles, record.config.robot.arm))
    return best


def _accuracy(
    config: CellConfig,
    joint: JointResult,
    marks: Sequence[Mark],
    judged: Judged | None,
    base: Calibration,
    best: Calibration,
) -> dict[str, Any]:
    """What error to expect, and what was measured with fewer circles."""
    told = accuracy.told(joint, accuracy.places(config))
    if judged is None:
        return told
    return accuracy.with_learning(told, accuracy.learning(marks, judged, base, best))


def _evaluated(
    record: Record[FullParams], best: Calibration, result: RefineResult
) -> tuple[Judged | None, tuple[str, ...]]:
    """The circles that no fit has seen, if it came to them, and why they fail."""
    part = record.scoped(EVALUATE, record.params.evaluate)
    if not part.samples(PICTURES):
        return None, ("no circle was drawn that no fit has seen",)
    noise = Noise(result.tcp_mm, result.mark_sigma_mm, result.mark_freedom)
    try:
        judged = evaluate.solve(part, best, noise)
    except SolveError as error:
        return None, (error.message,)
    return judged, tuple(evaluate.judge(judged, record.params.evaluate))


def _stage(stage: Stage) -> dict[str, Any]:
    return {
        "name": stage.name,
        "training_px": stage.training_px,
        "held_out_px": stage.held_out_px,
        "calibration": stage.calibration.to_dict(),
    }


PROCEDURE = Procedure(
    name="full",
    summary="Everything, unattended, from the boards to circles that no fit has seen; the verdict",
    params=FullParams,
    moves=True,
    run=run_full,
    conclude=conclude,
)
