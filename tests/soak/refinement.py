"""Worlds drawn, refined and evaluated without pictures: what is reached, and how often the
interval of an evaluation holds the true error. `python -m tests.soak.refinement --worlds 200`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.evaluate import Evaluation, evaluate
from cellctl.calib.refine import solve_refine
from cellctl.calib.refine_fit import FAMILIES, Marks
from cellctl.calib.refine_result import RefineResult
from cellctl.sim.presets import PRESETS
from tests.calib.drawn import DETECTION_PX, DrawnCell, layout, quick_cell, solved_cell

PLAIN = ("none", "shift", "similarity", "affine", "projective", "quadratic")


def verify(
    cell: DrawnCell, calibration: Calibration, refined: RefineResult, rng: np.random.Generator
) -> Evaluation:
    """Twelve circles more, drawn at the drawing posture, beside those that are projected there."""
    xy = layout(cell.truth, rng, rounds=1)
    drawn = Marks.of(cell.marks(xy, rng, np.zeros(len(xy))), cell.base)
    points = np.column_stack([xy, np.full(len(xy), cell.grid.height)])
    pixels = cell.truth.camera.project(cell.truth.light_lands(calibration.project(points)))
    light = cell.base.camera.normalise(pixels + rng.normal(0.0, DETECTION_PX, pixels.shape))
    projector = cell.base.projector
    return evaluate(
        drawn.keys,
        projector.project(light) - projector.project(drawn.seen),
        drawn.on_table_mm(light) - drawn.on_table_mm(drawn.seen),
        mark_sigma_mm=refined.mark_sigma_mm,
        mark_freedom=refined.mark_freedom,
    )


def world(
    seed: int, families: Sequence[str] = PLAIN, *, solved: bool = False, preset: str = "cr"
) -> dict[str, float]:
    """One cell: true_mm by family ("chosen" too), the verification's figures, and whether its
    interval held the true error, of the refined calibration and of the base."""
    cell = solved_cell(seed) if solved else quick_cell(seed, preset)
    rng = np.random.default_rng([seed, 7])
    result = solve_refine(cell.marks(layout(cell.truth, rng), rng), cell.base, families=families)
    figures = {
        c.name: cell.score(replace(cell.base, refinement=c.fit.refinement))
        for c in result.candidates
        if c.fit is not None
    }
    figures["chosen"] = figures[result.chosen]
    refined = replace(cell.base, refinement=result.refinement)
    for name, calibration in (("refined", refined), ("base", cell.base)):
        found = verify(cell, calibration, result, rng)
        low, high = found.held_out_ci_mm
        true = cell.score(calibration)
        figures |= {f"{name}_held_out": found.held_out_mm, f"{name}_low": low, f"{name}_high": high}
        figures[f"{name}_covered"] = float(low <= true <= high)
    figures["leave_one_out"] = result.errors["leave_one_out"].mm
    figures["leave_row_out"] = result.errors["leave_row_out"].mm
    figures["mark_sigma"] = result.mark_sigma_mm
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=200)
    parser.add_argument("--preset", default="cr", choices=sorted(PRESETS))
    parser.add_argument("--solved", action="store_true", help="solve the base calibration too")
    parser.add_argument("--kernels", action="store_true", help="all families")
    options = parser.parse_args()
    families = [family.name for family in FAMILIES] if options.kernels else PLAIN
    found = []
    for seed in range(options.worlds):
        found.append(world(seed, families, solved=options.solved, preset=options.preset))
        covered = [int(found[-1][f"{name}_covered"]) for name in ("refined", "base")]
        print(f"seed {seed}: true {found[-1]['chosen']:.3f} mm, covered {covered}", flush=True)
    for name in found[0]:
        values = np.array([figures[name] for figures in found])
        if name.endswith("_covered"):
            print(f"{name:18} {int(values.sum())} of {len(values)}")
        else:
            print(f"{name:18} median {np.median(values):.3f}  worst {values.max():.3f}")


if __name__ == "__main__":
    main()
