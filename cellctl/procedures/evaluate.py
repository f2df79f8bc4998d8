"""How good it is: circles that no fit has seen, with rings of light that the calibration puts
around them. Both are measured in one picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import evaluate
from cellctl.calib.calibration import Calibration
from cellctl.calib.compare import Gaps, gaps_seen
from cellctl.calib.evaluate import Evaluation
from cellctl.calib.refine_fit import Mark
from cellctl.cell import Cell
from cellctl.errors import SolveError
from cellctl.geometry import Array
from cellctl.procedures import drawn, paper, pictures
from cellctl.procedures.draw import CIRCLES, DrawParams, active_of, draw_round, drawing_of
from cellctl.procedures.moving import posture
from cellctl.procedures.observations import picture
from cellctl.procedures.pictures import PICTURES, Search, find_drawn_and_lit
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run

WITH_RINGS = "with-rings"
LEAST_CIRCLES = 6


class EvaluateParams(BaseModel):
    """`circles` are drawn on places of their own, with the tool in its drawing posture wherever it
    can be. `max_held_out_mm`: their e_RMSE must stay below."""

    model_config = ConfigDict(extra="forbid")

    circles: int = Field(default=24, ge=6, le=200)
    radius_mm: float | None = Field(default=None, gt=2, le=200)
    pen_speed_mm_s: float = Field(default=60.0, gt=0, le=500)
    search_mm: float = Field(default=5.0, gt=0, le=100)
    seed: int = Field(default=1, ge=0)
    max_held_out_mm: float = Field(default=1.0, gt=0)

    def drawing(self) -> DrawParams:
        """As one round of `draw`."""
        return DrawParams(
            spots=self.circles,
            rounds=1,
            radius_mm=self.radius_mm,
            pen_speed_mm_s=self.pen_speed_mm_s,
            search_mm=self.search_mm,
            seed=self.seed,
        )


@dataclass(frozen=True, eq=False)
class Noise:
    """What is known of the pen from the circles that were fitted: by how much it stands off,
    `tcp_mm` (2,), and the noise of a mark per axis with its degrees of freedom (0: unknown)."""

    tcp_mm: Array
    sigma_mm: float
    freedom: float

    @classmethod
    def of(cls, calibration: Calibration) -> Noise:
        """As a calibration remembers it."""
        quality = calibration.quality
        return cls(
            np.array(quality.get("tcp_off_mm", (0.0, 0.0)), dtype=float),
            float(quality.get("mark_sigma_mm", 0.0)),
            float(quality.get("mark_freedom", 0.0)),
        )


@dataclass(frozen=True, eq=False)
class Judged:
    """The marks with the gaps between them and their light, and what is said of them all."""

    marks: list[Mark]
    gaps: Gaps
    evaluation: Evaluation
    lost: Mapping[str, str]

    def quality(self) -> dict[str, Any]:
        """What a calibration remembers of it."""
        return {
            "held_out_px": self.evaluation.held_out_px,
            "held_out_mm": self.evaluation.held_out_mm,
            "held_out_ci_mm": list(self.evaluation.held_out_ci_mm),
        }

    def to_dict(self) -> dict[str, Any]:
        figures = self.evaluation.to_dict()
        del figures["circles"], figures["per_circle"]
        return {
            **figures,
            "circles": [
                {
                    "key": mark.key,
                    "x": float(mark.xy[0]),
                    "y": float(mark.xy[1]),
                    "error_px": px.tolist(),
                    "error_mm": mm.tolist(),
                }
                for mark, px, mm in zip(self.marks, self.gaps.px, self.gaps.mm, strict=True)
            ],
            "rejected": [{"id": key, "reason": reason} for key, reason in self.lost.items()],
        }


async def collect(run: Run, cell: Cell, params: EvaluateParams, calibration: Calibration) -> None:
    """Draw the circles, then show the rings and take the picture."""
    asked = params.drawing()
    here = await posture(run, cell)
    drawing = drawing_of(cell.config, cell.guard, calibration, asked, here)
    await pictures.blank(run, cell, calibration)
    sight = await pictures.sight(run, calibration, pictures.RING_FACTOR)
    await run.step(CIRCLES, drawing.count)
    spots = await paper.planned(
        run,
        cell,
        drawing.rig,
        drawing.count,
        drawing.radius,
        drawing.seed,
        turned=False,
        sight=sight,
    )
    await draw_round(run, cell, drawing, spots, 0, 0)
    circles = drawn.circles(run.samples(CIRCLES))
    search = 1e-3 * params.search_mm
    await pictures.with_rings(run, cell, calibration, WITH_RINGS, circles, search)


def seen(
    record: Record[EvaluateParams], calibration: Calibration
) -> tuple[list[Mark], Array, dict[str, str]]:
    """Marks, where their light was seen (n, 2) in undistorted normalised coordinates, and why
    others are missing."""
    sample = record.samples(PICTURES)[WITH_RINGS]
    circles = drawn.circles(record.samples(CIRCLES))
    found = sample.data
    if record.again:
        search = Search(
            calibration, 1e-3 * record.params.search_mm, record.config.bracket.pen.line_m
        )
        found = find_drawn_and_lit(picture(sample), search, circles)
    lost = {
        key: f"{what}: {item['unseen']}"
        for what, items in (("drawn", found["drawn"]), ("projected", found["lit"]))
        for key, item in items.items()
        if "unseen" in item
    }
    both = [circle for circle in circles if circle.key not in lost]
    marks = drawn.marks_of(both, found["drawn"], calibration.camera)
    lit = np.array([found["lit"][circle.key]["centre_px"] for circle in both]).reshape(-1, 2)
    return marks, calibration.camera.normalise(lit), lost


def solve(record: Record[EvaluateParams], calibration: Calibration, noise: Noise) -> Judged:
    """Pure: the errors of the circles. SolveError when too few were found."""
    marks, lit, lost = seen(record, calibration)
    if len(marks) < LEAST_CIRCLES:
        some = "; ".join(f"{key}: {reason}" for key, reason in list(lost.items())[:3])
        raise SolveError(
            f"only {len(marks)} circles were found, {LEAST_CIRCLES} are needed: {some}"
        )
    between = gaps_seen(lit, marks, calibration, noise.tcp_mm)
    evaluation = evaluate.evaluate(
        [mark.key for mark in marks],
        between.px,
        between.mm,
        mark_sigma_mm=noise.sigma_mm,
        mark_freedom=noise.freedom,
    )
    return Judged(marks, between, evaluation, lost)


def judge(judged: Judged, params: EvaluateParams) -> list[str]:
    """Why it fails; empty when it passes."""
    error = judged.evaluation.held_out_mm
    reasons = []
    if not error <= params.max_held_out_mm:
        reasons.append(
            f"light and ink are {error:.2f} mm apart on circles that no fit has seen, over the "
            f"limit of {params.max_held_out_mm} mm"
        )
    total = len(judged.marks) + len(judged.lost)
    if len(judged.lost) > drawn.LOST_SHARE * total:
        key, reason = next(iter(judged.lost.items()))
        reasons.append(f"{len(judged.lost)} of {total} circles were not found; {key}: {reason}")
    return reasons


def conclude(record: Record[EvaluateParams]) -> Result:
    """Pure: from what was recorded to the error of the active calibration."""
    calibration = active_of(record.active)
    judged = solve(record, calibration, Noise.of(calibration))
    data = {"kind": "evaluate", **judged.to_dict()}
    return Result.judged(judge(judged, record.params), data)


async def run_evaluate(run: Run, cell: Cell, params: EvaluateParams) -> Result:
    """Collect, judge."""
    await collect(run, cell, params, active_of(run.calibration))
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="evaluate",
    summary="Proof: draws circles that no fit has seen, and lights rings around them",
    params=EvaluateParams,
    moves=True,
    run=run_evaluate,
    conclude=conclude,
)
