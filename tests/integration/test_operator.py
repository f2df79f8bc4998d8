"""A person at the cell: paper that is full, and a pen that feels nothing."""

from __future__ import annotations

import re

import numpy as np
import pytest

from cellctl.config import load_config
from cellctl.errors import MotionRefused
from tests.integration.drawing import assert_one_circle_each, drawn, ledger
from tests.integration.known_cell import FRESH, known_cell

TURNS = (
    (180, 0, 0),
    (180, -30, 0),
    (160, 0, 0),
    (180, 20, 0),
    (180, 0, -30),
    (150, 0, 0),
)
"""Of the flange, rpy in degrees, in which it is free to stand over the table."""


def jog_to(cell, point):
    """With the tool turned so that nothing is touched on the way."""
    for yaw in (0.0, 60.0, -60.0, 120.0, -120.0, 180.0):
        try:
            cell.plant("pendant.place", point=point, rpy_deg=[180.0, 0.0, yaw])
        except MotionRefused:
            continue
        return
    raise AssertionError(f"no way to {point}")


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    """A cell whose pen feels nothing, and whose paper is full."""
    folder = tmp_path_factory.mktemp("worn")
    with known_cell(folder, pen={"feels_contact": False}, full=True) as cell:
        yield cell


def test_full_paper_is_asked_about_and_replaced(worn):
    few = {"spots": 4, "rounds": 1}
    asked = []

    def cancel(question):
        asked.append(question.text)
        return "cancel"

    assert worn.run("draw", answer=cancel, **few).status == "cancelled"
    assert "room for only 0 of 4 circles: lay a fresh sheet on A" in asked[0]
    assert ledger(worn)["laid"] == 1
    drawing = worn.run("draw", **few)
    assert (drawing.status, drawing.reasons) == ("done", [])
    assert ledger(worn)["laid"] == 2
    assert {spot["owner"].split("/")[0] for spot in ledger(worn)["spots"]} == {drawing.run_id}
    assert_one_circle_each(worn, drawn(worn, drawing.run_id).values())


def test_an_operator_finds_the_table_with_the_pendant(worn):
    def touch(question):
        if question.choices[0].startswith(FRESH):
            return worn.lay_paper(question)
        x, y = (1e-3 * float(v) for v in re.findall(r"[xy] = (-?\d+) mm", question.text))
        jog_to(worn, [x, y, worn.height(x, y)])
        return question.choices[0]

    table = worn.run("measure-table", touches=9, answer=touch)
    assert (table.verdict, table.reasons) == ("pass", [])


def test_an_operator_finds_the_pen_by_pivoting(worn):
    worn.plant("pen.off", shift_mm=[6.0, 0.0, 0.0])
    posture = load_config(worn.config).bracket.pen.posture_deg
    assert posture is not None
    worn.plant("pendant.jog", joints=np.radians(posture).tolist())
    turns = iter(2 * TURNS)

    def place(question):
        worn.plant("pendant.place", point=[0.0, -0.4, 0.2], rpy_deg=list(next(turns)))
        return question.choices[0]

    found = worn.run("tcp", poses=2 * len(TURNS), answer=place)
    assert (found.verdict, found.reasons) == ("pass", [])
    true = worn.tip()
    worn.plant("pen.off", shift_mm=[-6.0, 0.0, 0.0])
    data = found.result["data"]
    tip_mm = 1e3 * np.array(data["stated_tip_m"]) + data["off_mm"]
    assert np.linalg.norm(tip_mm - 1e3 * true) < 0.3
