"""Refinement: known corrections come back, the right one is chosen, nonsense is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.refine import rows, solve_refine
from cellctl.calib.refine_fit import (
    FAMILIES,
    LARGEST_CONDITION,
    Frame,
    Mark,
    Marks,
    condition,
    fit,
    held_out_fits,
)
from cellctl.calib.refine_result import RefineResult
from cellctl.calib.refinement import Refinement
from cellctl.errors import BadInput, SolveError
from tests.calib.drawn import YAWS, DrawnCell, layout, quick_cell

PLAIN = ("none", "shift", "similarity", "affine", "projective", "quadratic")
"""The kernels are tested by themselves: they take seconds."""


@pytest.fixture(scope="module")
def cell() -> DrawnCell:
    return quick_cell(3)


@pytest.fixture(scope="module")
def marks(cell) -> list[Mark]:
    rng = np.random.default_rng(1)
    return cell.marks(layout(cell.truth, rng), rng)


@pytest.fixture(scope="module")
def whole(cell, marks) -> RefineResult:
    return solve_refine(marks, cell.base)


def synthetic(cell: DrawnCell, refinement: Refinement, tcp_mm: np.ndarray, count: int = 60):
    """Marks without noise, as the model itself has them."""
    xy = layout(cell.truth, np.random.default_rng(5))[:count]
    bare = [Mark(f"{i:03d}", p, float(YAWS[i % 3]), np.zeros(2)) for i, p in enumerate(xy)]
    seen = refinement.apply(Marks.of(bare, cell.base).chain(1e-3 * tcp_mm))
    return [replace(mark, seen=place) for mark, place in zip(bare, seen, strict=True)]


def correction(family: str) -> Refinement:
    H = {
        "shift": [[1, 0, 0.003], [0, 1, -0.002], [0, 0, 1]],
        "similarity": [[1.002, 0.001, 0.003], [-0.001, 1.002, 0.001], [0, 0, 1]],
        "projective": [[1.002, 0.001, 0.003], [0.0, 0.998, 0.001], [0.003, -0.002, 1]],
    }.get(family, [[1.002, 0.001, 0.003], [0.0, 0.998, 0.001], [0, 0, 1]])
    rows_ = {"quadratic": 3, "cubic": 7}.get(family, 0)
    polynomial = 0.004 * np.random.default_rng(2).normal(size=(rows_, 2))
    return Refinement(family, np.array([0.01, 0.02]), 0.4, np.array(H, float), polynomial)


@pytest.mark.parametrize("family", [*PLAIN[1:], "cubic"])
def test_a_known_correction_comes_back(cell, family):
    """With a pen that is 6 mm off, and drawn at three yaws."""
    tcp = np.array([4.0, -4.5])
    drawn = synthetic(cell, correction(family), tcp)
    result = solve_refine(drawn, cell.base, families=[family])
    assert np.abs(result.errors_mm).max() < 5e-3  # what the prior of the pen's offset pulls
    assert np.abs(result.tcp_mm - tcp).max() < 5e-3
    assert result.errors["leave_row_out"].mm < 0.02


@pytest.mark.parametrize("family", ["rbf", "thin-plate"])
def test_kernels_bend_where_polynomials_do_not(cell, family):
    """A bump of 1 mm in the middle."""
    plain = Refinement("none")
    drawn = synthetic(cell, plain, np.zeros(2))
    seen = np.array([mark.seen for mark in drawn])
    away = (seen - seen.mean(axis=0)) / 0.15
    bump = 1.2e-3 * np.exp(-0.5 * np.square(away).sum(axis=1))[:, None] * [1.0, -0.5]
    drawn = [replace(m, seen=m.seen + b) for m, b in zip(drawn, bump, strict=True)]
    bent = solve_refine(drawn, cell.base, families=["affine", "quadratic", family])
    assert bent.chosen == family
    held_out = {c.name: c.errors["leave_one_out"].mm for c in bent.candidates}
    assert held_out[family] < 0.75 * held_out["quadratic"]


def test_circles_make_the_calibration_better(cell, whole):
    refined = replace(cell.base, refinement=whole.refinement)
    assert cell.score(cell.base) > 0.6
    assert cell.score(refined) < 0.25
    assert all(
        cell.score(replace(cell.base, refinement=c.fit.refinement)) < 0.3
        for c in whole.candidates
        if c.fit is not None and c.name not in ("none", "shift")
    )


def test_the_result_says_what_it_rests_on(cell, whole):
    names = [family.name for family in FAMILIES]
    names.insert(names.index("projective") + 1, "challenger")
    assert [c.name for c in whole.candidates] == names
    assert whole.refinement.family == whole.chosen
    assert "held-out error" in whole.why
    assert 0.13 < whole.mark_sigma_mm < 0.23  # drawn with 0.166 mm
    assert 80 < whole.mark_freedom < 118
    assert not whole.rejected
    for candidate in whole.candidates:
        errors = candidate.errors
        assert errors["training"].mm < errors["leave_one_out"].mm
        assert errors["leave_one_out"].px == pytest.approx(
            errors["leave_one_out"].mm / 0.43, rel=0.1
        )
    document = json.loads(json.dumps(whole.to_dict(), allow_nan=False))
    assert Refinement.from_dict(document["refinement"]).to_dict() == whole.refinement.to_dict()
    assert document["per_circle"]["circle-007"]["px"] == whole.errors_px[7].tolist()
    assert document["candidates"]["cubic"]["allowed"] is True


def test_more_freedom_is_not_taken_without_need(cell):
    """Where the truth is a similarity, the richer families fit better and are not chosen."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        drawn = synthetic(cell, correction("similarity"), np.zeros(2))
        noisy = [replace(m, seen=m.seen + rng.normal(0, 2e-4, 2)) for m in drawn]
        result = solve_refine(noisy, cell.base, families=[*PLAIN, "cubic"])
        training = {c.name: c.errors["training"].mm for c in result.candidates}
        assert training["cubic"] < training["similarity"]
        assert result.chosen == "similarity"


def test_a_cubic_on_a_grid_is_refused_though_held_out_errors_like_it(cell):
    """4 x 3 spots drawn five times: a cubic that is zero on the three rows is zero at every
    circle, so no circle left out can tell how large it is."""
    rng = np.random.default_rng(0)
    regular = cell.marks(layout(cell.truth, rng, jitter=0.0), rng)
    result = solve_refine(regular, cell.base, families=["affine", "cubic"])
    assert "condition number" in result.candidate("cubic").refused
    assert result.chosen == "affine"
    jittered = Marks.of(cell.marks(layout(cell.truth, rng), rng), cell.base)
    cubic = FAMILIES[-1]
    assert condition(cubic, jittered, Frame.of(jittered)) < LARGEST_CONDITION / 2


@pytest.mark.parametrize("family", [f for f in FAMILIES if f.kernel == "none"])
def test_one_step_without_a_circle_is_the_whole_way(cell, marks, family):
    drawn = Marks.of(marks, cell.base)
    frame = Frame.of(drawn)
    fold = np.arange(len(drawn)) % 7
    for number, rest in held_out_fits(family, drawn, frame, fit(family, drawn, frame), fold):
        afresh = fit(family, drawn[fold != number], frame)
        off = drawn.on_table_mm(rest.predict(drawn)) - drawn.on_table_mm(afresh.predict(drawn))
        assert np.abs(off).max() < 1e-3
        assert rest.freedom == pytest.approx(afresh.freedom, abs=0.01)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 24])
@pytest.mark.parametrize("line", [(1.0, 0.0), (0.0, 1.0), (1.0, 0.5), (0.0, 0.0)])
def test_circles_on_a_line_or_a_spot_determine_no_more_than_they_do(cell, count, line):
    rng = np.random.default_rng(0)
    along = rng.uniform(-0.15, 0.15, (count, 1)) * np.array(line)
    xy = cell.truth.preset.table.centre_m[:2] + along
    result = solve_refine(cell.marks(xy, rng), cell.base, families=[*PLAIN, "cubic"])
    assert result.chosen in ("none", "shift", "similarity")
    assert np.isfinite(result.errors_mm).all()


def test_rows_and_columns_are_left_out_whole():
    xy = np.stack(np.meshgrid(np.linspace(-1, 1, 4), np.linspace(0, 1, 3)), axis=-1).reshape(-1, 2)
    columns, bands = rows(xy)
    assert [len(set(columns[xy[:, 0] == x])) for x in np.unique(xy[:, 0])] == [1] * 4
    assert [len(set(bands[xy[:, 1] == y])) for y in np.unique(xy[:, 1])] == [1] * 3
    assert len(set(columns)) == 4
    assert len(set(bands)) == 3


@pytest.mark.parametrize(
    ("count", "richest"),
    [(4, "shift"), (6, "similarity"), (10, "affine"), (12, "projective"), (23, "projective")],
)
def test_few_circles_allow_little(cell, marks, count, richest):
    result = solve_refine(marks[:count], cell.base, families=PLAIN)
    allowed = [c.name for c in result.candidates if not c.refused]
    assert allowed == list(PLAIN[: PLAIN.index(richest) + 1])
    assert f"circles, not {count}" in result.candidates[-1].refused


def test_bad_circles_are_rejected_and_still_counted(cell, marks, whole):
    bad = {7: 3e-3, 20: -5e-3, 41: 2e-3}
    spoilt = [replace(m, seen=m.seen + bad.get(i, 0.0)) for i, m in enumerate(marks)]
    result = solve_refine(spoilt, cell.base, families=PLAIN)
    assert [r.id for r in result.rejected] == ["circle-007", "circle-020", "circle-041"]
    assert "mm from where the others say" in result.rejected[0].reason
    errors = result.errors
    assert errors["leave_one_out"].mm < 1.2 * whole.errors["leave_one_out"].mm
    assert errors["leave_one_out_all"].mm > 2 * errors["leave_one_out"].mm
    assert cell.score(replace(cell.base, refinement=result.refinement)) < 0.3


@pytest.mark.parametrize("tcp_mm", [(0.5, -0.4), (4.0, 4.5), (-10.0, 2.0)])
def test_the_pens_offset_is_found_and_does_no_harm(cell, tcp_mm):
    """The world point is where this pen stands: its offset is no error of the calibration."""
    flange = np.array([tcp_mm[0], -tcp_mm[1], 0.0]) * 1e-3  # the tool points down
    moved = replace(cell, truth=replace(cell.truth, pen=cell.truth.nominal_pen + flange))
    rng = np.random.default_rng(2)
    result = solve_refine(moved.marks(layout(moved.truth, rng), rng), moved.base, families=PLAIN)
    assert np.linalg.norm(result.tcp_mm - tcp_mm) < 0.35  # the wrist's own error is in there
    assert moved.score(replace(moved.base, refinement=result.refinement)) < 0.25


def test_one_yaw_tells_nothing_of_the_pen(cell):
    rng = np.random.default_rng(4)
    xy = layout(cell.truth, rng)
    result = solve_refine(cell.marks(xy, rng, np.zeros(len(xy))), cell.base, families=PLAIN)
    assert np.abs(result.tcp_mm).max() < 1e-6
    assert np.sqrt(result.tcp_covariance_mm2.diagonal()).min() > 5.0
    assert cell.score(replace(cell.base, refinement=result.refinement)) < 0.25


def test_the_covariance_is_that_of_repeated_solves(cell):
    xy = layout(cell.truth, np.random.default_rng(0))
    found = [
        solve_refine(cell.marks(xy, np.random.default_rng(i)), cell.base, families=["affine"])
        for i in range(20)
    ]
    scatter = np.std([r.tcp_mm for r in found], axis=0, ddof=1)
    stated = np.sqrt(np.mean([r.tcp_covariance_mm2.diagonal() for r in found], axis=0))
    assert np.all(np.abs(np.log(scatter / stated)) < 0.5)


def test_the_order_of_the_circles_does_not_matter(cell, marks):
    one = solve_refine(marks, cell.base, families=PLAIN)
    other = solve_refine(marks[::-1], cell.base, families=PLAIN)
    assert one.to_dict() == other.to_dict()


def test_circles_that_contradict_each_other_are_an_error(cell, marks):
    rng = np.random.default_rng(0)
    chaos = [
        replace(m, seen=m.seen + rng.uniform(-0.1, 0.1, 2) * (i % 2)) for i, m in enumerate(marks)
    ]
    with pytest.raises(SolveError, match="circles agree with each other"):
        solve_refine(chaos, cell.base)


def test_bad_input_is_named(cell, marks):
    with pytest.raises(SolveError, match="only 3 circles were measured, 4 are needed"):
        solve_refine(marks[:3], cell.base)
    with pytest.raises(BadInput, match="'circle-001' is listed more than once"):
        solve_refine([*marks[:5], marks[1]], cell.base)
    lost = replace(marks[2], seen=np.array([np.nan, 0.0]))
    with pytest.raises(BadInput, match="'circle-002' has a coordinate that is not finite"):
        solve_refine([*marks[:2], lost, *marks[3:6]], cell.base)
