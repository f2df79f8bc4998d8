"""The whole way of a drawing: table, circles, correction and proof. Camera, projector and pose are
known from the start."""

from __future__ import annotations

import numpy as np
import pytest

from tests.integration.drawing import (
    CIRCLES,
    DRAW,
    assert_apart,
    assert_one_circle_each,
    drawn,
    ledger,
    rings,
)
from tests.integration.known_cell import BOWED, known_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    with known_cell(tmp_path_factory.mktemp("drawing")) as cell:
        yield cell


def test_it_draws_and_proves_it(cell):
    table = cell.run("measure-table", touches=9)
    assert (table.verdict, table.reasons) == ("pass", [])
    cell.promote(table.calibration_id)
    drawing = cell.run("draw", **DRAW)
    assert (drawing.verdict, drawing.reasons) == ("pass", [])
    circles = drawn(cell, drawing.run_id)
    assert len(circles) == CIRCLES
    order = assert_one_circle_each(cell, circles.values())
    camera, T_world_camera = cell.camera()
    centres = np.array([ink["centre_m"] for ink in rings(cell)])[order]
    seen = [c["centre_px"] for c in drawing.result["data"]["circles"]]
    true = camera.project(T_world_camera.inverse().apply(centres))
    assert np.abs(true - seen).max() < 0.3
    refined = cell.run("refine")
    assert (refined.verdict, refined.reasons) == ("pass", [])
    cell.promote(refined.calibration_id)
    final = cell.calibration(refined.calibration_id)
    proof = cell.run("evaluate", circles=12)
    assert (proof.verdict, proof.reasons) == ("pass", [])
    low, high = proof.result["data"]["held_out_ci_mm"]
    true_mm = cell.true_mm(final)
    assert low <= true_mm <= high
    assert true_mm < 0.6
    spots = ledger(cell)["spots"]
    assert len(spots) == 9 + CIRCLES + 12
    assert {spot["state"] for spot in spots} == {"drawn"}
    assert_apart(spots)


def test_a_table_that_is_not_known_well_enough_is_not_drawn_on(cell):
    cell.promote(BOWED)
    refused = cell.run("draw", **DRAW)
    assert refused.status == "failed"
    assert "together more than half of the 5.0 mm that the pen holder gives way" in refused.error
