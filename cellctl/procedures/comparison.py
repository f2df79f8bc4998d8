"""The paper's Table II, our own: every stage's light against the ink, on the circles that were
fitted and on those that no fit has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cellctl import published
from cellctl.calib.calibration import Calibration
from cellctl.calib.compare import Gaps, gaps
from cellctl.calib.refine_fit import Mark
from cellctl.calib.stages import Stage
from cellctl.geometry import Array
from cellctl.procedures.evaluate import Judged

STAGE_OF = {
    "original camera": "factory K, D; homography on raw pixels",
    "intrinsic": "calibrated K, D; homography on raw pixels",
    "hand-eye": "hand-eye by reprojection",
    "projector": "projector radial distortion",
}
"""Which stage of `stages.ROWS` stands in which row of the table."""


@dataclass(frozen=True, eq=False)
class Circles:
    """`fitted` marks, `unseen` ones as far as they were evaluated; `best` is the calibration by
    which light and ink are compared, with the pen `tcp_mm` (2,) off."""

    fitted: Sequence[Mark]
    unseen: Judged | None
    best: Calibration
    tcp_mm: Array


def table(stages: Sequence[Stage], circles: Circles, arm: str) -> dict[str, Any]:
    """`table`: rows with training and held-out px and mm, the paper's beside them; `arrows`: from
    ink to light at every circle, by row."""
    rows, arrows = [], {}
    for name, calibration in _calibrations(stages, circles.best).items():
        fitted = gaps(calibration, circles.fitted, circles.best, circles.tcp_mm)
        unseen = _unseen(name, calibration, circles)
        px, mm = published.figures(arm, name)
        rows.append(
            {
                "row": name,
                "training_px": fitted.rms_px,
                "training_mm": fitted.rms_mm,
                "held_out_px": unseen.rms_px if unseen else None,
                "held_out_mm": unseen.rms_mm if unseen else None,
                "paper_px": px,
                "paper_mm": mm,
            }
        )
        arrows[name] = _arrows(circles.fitted, fitted, held_out=False)
        if unseen and circles.unseen:
            arrows[name] += _arrows(circles.unseen.marks, unseen, held_out=True)
    return {"table": rows, "arrows": arrows}


def _calibrations(stages: Sequence[Stage], best: Calibration) -> Mapping[str, Calibration]:
    """By row of the table."""
    by_name = {stage.name: stage.calibration for stage in stages}
    found = {row: by_name[stage] for row, stage in STAGE_OF.items()}
    return {**found, "refinement": best}


def _unseen(row: str, calibration: Calibration, circles: Circles) -> Gaps | None:
    """The last row's light was shown and seen; that of the others is worked out."""
    if circles.unseen is None:
        return None
    if row == "refinement":
        return circles.unseen.gaps
    return gaps(calibration, circles.unseen.marks, circles.best, circles.tcp_mm)


def _arrows(marks: Sequence[Mark], between: Gaps, *, held_out: bool) -> list[dict[str, Any]]:
    return [
        {
            "key": mark.key,
            "x": float(mark.xy[0]),
            "y": float(mark.xy[1]),
            "dx_mm": float(dx),
            "dy_mm": float(dy),
            "held_out": held_out,
        }
        for mark, (dx, dy) in zip(marks, between.mm, strict=True)
    ]
