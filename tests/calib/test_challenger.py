"""The challenger: circles alone, whatever hand-eye says; its field no larger than they ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.calibration import Calibration
from cellctl.calib.challenger import NO_FIELD_MM, challenger_family, seated
from cellctl.calib.refine import choose, solve_refine
from cellctl.calib.refine_fit import FAMILIES, Frame, Mark, Marks, fit
from cellctl.calib.refine_result import RefineResult
from cellctl.errors import SolveError
from cellctl.geometry import Transform, pose_matrix
from cellctl.sim.presets import CR
from tests.calib.drawn import DrawnCell, layout, quick_cell

ALL = ("none", "shift", "similarity", "affine", "projective", "challenger", "quadratic")
HAND_EYE = ("none", "shift", "similarity", "joint")


@pytest.fixture(scope="module")
def cell() -> DrawnCell:
    return quick_cell(3)


@pytest.fixture(scope="module")
def marks(cell) -> list[Mark]:
    rng = np.random.default_rng(1)
    return cell.marks(layout(cell.truth, rng), rng)


def refined(cell: DrawnCell, base: Calibration, result: RefineResult) -> Calibration:
    return replace(base, refinement=result.refinement)


def test_it_does_not_feel_what_hand_eye_says(cell, marks):
    """Two degrees and five centimetres off, or no hand-eye at all: light goes where it went."""
    off = pose_matrix((0.03, -0.02, 0.01), (0.05, -0.03, 0.04))
    wrong = replace(
        cell.base,
        T_world_camera=Transform("world", "camera", cell.base.T_world_camera.matrix @ off),
    )
    without = seated(marks, cell.base.camera, cell.base.projector, cell.base.table)
    sent = []
    for base in (cell.base, wrong, without):
        result = solve_refine(marks, base, families=["challenger"])
        sent.append(refined(cell, base, result).project(cell.grid.points))
    assert np.abs(sent[0] - cell.base.project(cell.grid.points)).max() > 1.0
    assert np.abs(sent[1] - sent[0]).max() < 0.05
    assert np.abs(sent[2] - sent[0]).max() < 0.05


def test_a_seat_is_near_to_where_the_camera_hangs(cell, marks):
    base = seated(marks, cell.base.camera, cell.base.projector, cell.base.table)
    gap = base.T_world_camera.translation - cell.base.T_world_camera.translation
    assert np.linalg.norm(gap) < 0.02


def test_no_seat_from_three_circles(cell, marks):
    with pytest.raises(SolveError, match="3 circles do not seat a camera"):
        seated(marks[:3], cell.base.camera, cell.base.projector, cell.base.table)


def test_without_a_field_it_is_the_projective_family(cell, marks):
    drawn = Marks.of(marks, cell.base)
    frame = Frame.of(drawn)
    projective = next(f for f in FAMILIES if f.name == "projective")
    none = replace(challenger_family(drawn, frame), field_mm=1e-6)
    gap = fit(none, drawn, frame).errors_mm(drawn) - fit(projective, drawn, frame).errors_mm(drawn)
    assert np.abs(gap).max() < 1e-6


@pytest.mark.parametrize(("bent_mm", "low", "high"), [(0.0, 0.0, 0.05), (0.5, 0.1, 1.0)])
def test_the_field_is_as_large_as_the_circles_ask_for(cell, bent_mm, low, high):
    """Marks that a plane explains, with their noise; and the same bent by a cubic."""
    rng = np.random.default_rng(5)
    xy = layout(cell.truth, rng)
    bare = [Mark(f"{i:03d}", p, 0.0, np.zeros(2)) for i, p in enumerate(xy)]
    drawn = Marks.of(bare, cell.base)
    seen = drawn.chain(np.zeros(2))
    frame = Frame.of(replace(drawn, seen=seen))
    u = (seen - frame.centre) / frame.scale
    seen = seen + rng.normal(0.0, 0.17, seen.shape) / frame.mm * frame.scale
    seen = seen + (bent_mm / frame.mm * frame.scale) * np.column_stack([u[:, 0] ** 3, u[:, 0] ** 2])
    family = challenger_family(replace(drawn, seen=seen), frame)
    assert low <= family.field_mm <= high


def test_few_circles_get_none(cell, marks):
    drawn = Marks.of(marks[:8], cell.base)
    assert challenger_family(drawn, Frame.of(drawn)).field_mm == NO_FIELD_MM
    result = solve_refine(marks[:8], cell.base, families=ALL)
    assert "needs 12 circles, not 8" in result.candidate("challenger").refused


def test_a_bad_arm_makes_the_challenger_win():
    """Kinematic errors x3: what keeps hand-eye's pose is far off; the record says so in words."""
    errors = replace(CR.arm_errors, zero_sigma_deg=0.09, length_sigma_m=0.45e-3)
    gains = []
    for seed in range(4):
        cell = quick_cell(seed, replace(CR, arm_errors=errors))
        rng = np.random.default_rng([seed, 1])
        drawn = cell.marks(layout(cell.truth, rng), rng)
        covariance = np.diag([4e-4, 4e-4, 4e-4, 5e-4, 5e-4, 1e-3]) ** 2
        tied = solve_refine(drawn, cell.base, families=HAND_EYE, pose_covariance=covariance)
        free = solve_refine(drawn, cell.base, families=ALL)
        assert free.chosen in ("challenger", "quadratic")
        assert "without hand-eye" in free.why
        gains.append(
            cell.score(refined(cell, cell.base, free)) / cell.score(refined(cell, cell.base, tied))
        )
    assert np.median(gains) < 0.8


def test_another_must_be_better_beyond_chance(cell, marks):
    """A correction whose circles left out are off by a third of the challenger's is taken."""
    result = solve_refine(marks, cell.base, families=ALL)
    assert result.chosen == "challenger"
    better = result.candidate("similarity")
    challenger = result.candidate("challenger")
    third = challenger.left_one_out_mm / 3.0
    better = replace(better, held_out_mm=third, left_one_out_mm=third)
    chosen, why = choose([better, challenger])
    assert chosen is better
    assert "mm by the circles alone, without hand-eye" in why
    alone, why = choose([challenger])
    assert alone is challenger
    assert why.endswith("mm by the circles alone, without hand-eye")
