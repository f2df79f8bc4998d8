"""What goes wrong with pen and paper while circles are drawn, planted in the simulated cell."""

from __future__ import annotations

import re

import pytest

from tests.integration.drawing import DRAW, drawn
from tests.integration.known_cell import KNOWN, known_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    with known_cell(tmp_path_factory.mktemp("drawing")) as cell:
        yield cell


@pytest.fixture
def paper(cell):
    """The cell as it was in the beginning, but for what was drawn."""
    cell.promote(KNOWN)
    return cell


def faulty(cell, **params):
    """What a drawing, and the correction made from it, say."""
    drawing = cell.run("draw", **DRAW, **params)
    assert drawing.status == "done", drawing.error
    refined = cell.run("refine", drawing=drawing.run_id)
    return drawing, refined


def test_pen_that_slips_is_named(paper):
    paper.plant("pen.slip", shift_mm=[3.0, 0.0, 0.0], after_strokes=paper.strokes + 12)
    _, refined = faulty(paper)
    paper.plant("pen.slip", shift_mm=[-3.0, 0.0, 0.0])
    assert refined.verdict == "fail"
    slip = r"the pen slipped by (2\.9|3\.\d) mm between \S+ and \S+ \(after round 1\)"
    assert any(re.match(slip, reason) for reason in refined.reasons), refined.reasons


def test_sheet_that_moves_is_named(paper):
    """In round 2: what the picture before showed is seen somewhere else."""
    later = paper.strokes + 12 + 1
    paper.plant("sheet.move", sheet="A", shift_mm=[4.0, -3.0], turn_deg=0.3, after_strokes=later)
    drawing, _ = faulty(paper)
    paper.plant("sheet.replace")
    assert drawing.verdict == "fail"
    moved = r"the sheet A moved by (4\.9|5\.\d) mm \(0\.3 deg\) between after-0 and after-1"
    assert any(re.match(moved, reason) for reason in drawing.reasons), drawing.reasons


def test_pen_that_runs_dry_is_named(paper):
    paper.plant("pen.dry", after_strokes=paper.strokes + 15)
    drawing, _ = faulty(paper)
    paper.plant("pen.ink")
    assert drawing.verdict == "fail"
    dry = "the pen is dry: from circle-015 on"
    assert any(reason.startswith(dry) for reason in drawing.reasons), drawing.reasons


@pytest.mark.long
def test_pen_that_is_mounted_off_is_named(paper):
    paper.plant("pen.off", shift_mm=[6.0, 0.0, 0.0])
    drawing, refined = faulty(paper)
    paper.plant("pen.off", shift_mm=[-6.0, 0.0, 0.0])
    assert refined.verdict == "fail"
    off = r"the pen stands (5\.[5-9]|6\.[0-5]) mm from where bracket\.pen\.tip_m says"
    assert any(re.match(off, reason) for reason in refined.reasons), refined.reasons
    assert drawing.reasons == []


@pytest.mark.long
def test_circles_of_a_wrong_radius_are_named(paper):
    paper.plant("drawing.shrink", factor=0.8)
    drawing, _ = faulty(paper)
    paper.plant("drawing.shrink", factor=1.0)
    assert drawing.verdict == "fail"
    assert any("circles come out with a radius of" in r for r in drawing.reasons), drawing.reasons


@pytest.mark.long
def test_circles_that_are_half_drawn_are_left_out(paper):
    paper.plant("pen.weak", share=0.5, count=2, after_strokes=paper.strokes + 5)
    drawing = paper.run("draw", **DRAW)
    paper.plant("pen.ink")
    assert drawing.verdict == "pass", drawing.reasons
    rejected = {r["id"]: r["reason"] for r in drawing.result["data"]["rejected"]}
    assert list(rejected) == list(drawn(paper, drawing.run_id))[5:7]
    assert all(reason.startswith("half drawn") for reason in rejected.values()), rejected
