"""What goes wrong with circles is named, at several sizes, and nothing is named that did not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.marks import radii, sheet_motions, slip_reasons, slips, tcp_reasons
from cellctl.calib.refine import solve_refine
from cellctl.calib.refine_fit import Mark
from cellctl.geometry import Array
from tests.calib.drawn import YAWS, DrawnCell, layout, quick_cell


@pytest.fixture(scope="module")
def cells() -> list[DrawnCell]:
    return [quick_cell(seed) for seed in range(5)]


def drawn(cell: DrawnCell, seed: int, slip_mm: Array | None = None, at: int = 24) -> list[Mark]:
    """60 circles; from number `at` on the pen has moved in the tool."""
    rng = np.random.default_rng(seed)
    xy = layout(cell.truth, rng)
    yaws = YAWS[np.arange(len(xy)) % 3]
    pen = cell.truth.pen_lands(xy, cell.joints(xy, yaws))
    if slip_mm is not None:
        c, s = np.cos(yaws[at:]), np.sin(yaws[at:])
        pen[at:, 0] += 1e-3 * (c * slip_mm[0] - s * slip_mm[1])
        pen[at:, 1] += 1e-3 * (s * slip_mm[0] + c * slip_mm[1])
    pen[:, :2] += rng.normal(0.0, 1.66e-4, (len(xy), 2))
    return cell.seen(xy, yaws, pen, rng)


@pytest.mark.parametrize("size", [1.5, 3.0, 8.0])
@pytest.mark.parametrize("at", [4, 24, 31, 55])
def test_a_slip_is_found_where_it_was(cells, size, at):
    for seed, cell in enumerate(cells[:3]):
        angle = 2 * np.pi * seed / 3
        slip_mm = size * np.array([np.cos(angle), np.sin(angle)])
        marks = drawn(cell, seed, slip_mm, at)
        (found,) = slips(marks, cell.base)
        assert (found.after, found.before) == (marks[at - 1].key, marks[at].key)
        assert np.abs(found.mm - slip_mm).max() < max(0.3, 5 * found.sigma_mm)
        assert found.round_ended == (2 if at == 24 else None)


def test_a_slip_reads_well(cells):
    (reason,) = slip_reasons(slips(drawn(cells[0], 0, np.array([3.0, 0.0])), cells[0].base))
    assert reason.startswith(
        ("the pen slipped by 2.9 mm", "the pen slipped by 3.0 mm", "the pen slipped by 3.1 mm")
    )
    assert "between circle-023 and circle-024 (after round 2)" in reason


def test_two_slips_are_two(cells):
    marks = drawn(cells[1], 1, np.array([3.0, 1.0]), 20)
    later = drawn(cells[1], 1, np.array([-1.0, 1.0]), 20)
    both = marks[:44] + later[44:]
    assert [s.after for s in slips(both, cells[1].base)] == ["circle-019", "circle-043"]


def test_no_slip_is_seen_where_none_was(cells):
    """50 sets of circles, of five cells."""
    for seed in range(50):
        cell = cells[seed % len(cells)]
        assert slips(drawn(cell, seed), cell.base) == ()


@pytest.mark.parametrize("where", [slice(10, 11), slice(40, 42), slice(58, 60)])
def test_bad_circles_are_no_slip(cells, where):
    marks = drawn(cells[2], 2)
    marks[where] = [replace(mark, seen=mark.seen + 6e-3) for mark in marks[where]]
    assert slips(marks, cells[2].base) == ()


def test_a_slip_below_the_limit_is_not_reported(cells):
    assert slips(drawn(cells[0], 3, np.array([0.5, 0.0])), cells[0].base) == ()


def test_few_circles_say_nothing_of_slips(cells):
    assert slips(drawn(cells[0], 0, np.array([5.0, 0.0]))[20:28], cells[0].base) == ()


@pytest.mark.parametrize("tcp_mm", [(4.2, 4.2), (0.0, -4.0), (15.0, 0.0)])
def test_a_pen_far_from_its_place_is_named(cells, tcp_mm):
    flange = 1e-3 * np.array([tcp_mm[0], -tcp_mm[1], 0.0])
    for cell in cells[:2]:
        moved = replace(cell, truth=replace(cell.truth, pen=cell.truth.nominal_pen + flange))
        result = solve_refine(drawn(moved, 0), moved.base, families=["affine"])
        (reason,) = tcp_reasons(result.tcp_mm, result.tcp_covariance_mm2)
        assert "bracket.pen.tip_m" in reason
        assert "cellctl run tcp" in reason
        assert abs(float(reason.split(" mm")[0].split()[-1]) - np.hypot(*tcp_mm)) < 0.4
        assert slips(drawn(moved, 0), moved.base) == ()


def test_a_pen_in_its_place_is_not_named(cells):
    for seed in range(10):
        cell = cells[seed % len(cells)]
        result = solve_refine(drawn(cell, seed), cell.base, families=["affine"])
        assert tcp_reasons(result.tcp_mm, result.tcp_covariance_mm2) == ()
    for seed in range(50):
        offset = np.random.default_rng(seed).normal(0.0, 0.7, 2)
        assert tcp_reasons(offset, 0.05**2 * np.eye(2)) == ()


def test_an_offset_that_is_not_known_is_not_named():
    assert tcp_reasons(np.array([6.0, 0.0]), 400.0 * np.eye(2)) == ()


@pytest.mark.parametrize("size", [8.0, 9.3, 11.0, 20.0])
def test_a_wrong_radius_is_named(size):
    rng = np.random.default_rng(0)
    measured = rng.normal(size, 0.1, 60)
    measured[:5] += 7.0
    found = radii(measured, np.full(60, 10.0))
    assert found is not None
    (reason,) = found.reasons
    assert reason.startswith(f"circles come out with a radius of {size:.1f} mm instead of 10.0 mm")


def test_a_right_radius_is_not_named():
    for seed in range(50):
        rng = np.random.default_rng(seed)
        wanted = rng.choice([4.0, 10.0, 25.0])
        found = radii(rng.normal(wanted * 1.01, 0.1, 60), np.full(60, wanted))
        assert found is not None
        assert found.reasons == ()
    assert radii([], []) is None


def pictures(seed: int, mm: tuple[float, float], deg: float, sheet: int = 2):
    """Three pictures of 30 growing to 60 circles on two sheets; before the third, one sheet
    moves. Detection scatters by 0.03 mm."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-0.3, -0.6), (0.3, -0.25), (60, 2))
    sheets = {f"c{i:02d}": f"A{1 + (xy[i, 0] > 0)}" for i in range(60)}
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    on = (xy[:, 0] > 0) if sheet == 2 else np.ones(60, dtype=bool)
    middle = xy[on].mean(axis=0)
    moved = xy.copy()
    moved[on] = (xy[on] - middle) @ np.array([[c, s], [-s, c]]) + middle + 1e-3 * np.array(mm)
    found = []
    for k, (count, places) in enumerate(((30, xy), (45, xy), (60, moved))):
        noisy = places + rng.normal(0.0, 3e-5, xy.shape)
        found.append((f"picture {k + 1}", {f"c{i:02d}": noisy[i] for i in range(count)}))
    return found, sheets


@pytest.mark.parametrize(
    ("mm", "deg"), [((1.0, 0.0), 0.0), ((3.0, -3.0), 1.0), ((0.0, 0.0), 2.0), ((20.0, 5.0), -15.0)]
)
def test_a_moved_sheet_is_named(mm, deg):
    for seed in range(10):
        taken, sheets = pictures(seed, mm, deg)
        (found,) = sheet_motions(taken, sheets)
        assert (found.sheet, found.before, found.after) == ("A2", "picture 2", "picture 3")
        assert np.linalg.norm(found.mm - mm) < 0.6 + 0.04 * abs(deg) * 10
        assert abs(found.deg - deg) < 0.05


def test_a_moved_sheet_reads_well():
    taken, _ = pictures(0, (4.0, 1.3), 1.0, sheet=0)
    (found,) = sheet_motions(taken)
    assert found.reason.startswith("the sheet moved by 4.")
    assert "(1.0 deg) between picture 2 and picture 3" in found.reason
    assert found.to_dict()["circles"] == 45


def test_a_sheet_at_rest_is_not_named():
    for seed in range(50):
        taken, sheets = pictures(seed, (0.0, 0.0), 0.0)
        assert sheet_motions(taken, sheets) == ()
        assert sheet_motions(taken) == ()


def test_one_misread_circle_moves_no_sheet():
    taken, sheets = pictures(3, (0.0, 0.0), 0.0)
    taken[2][1]["c05"] = taken[2][1]["c05"] + 0.004
    assert sheet_motions(taken, sheets) == ()
