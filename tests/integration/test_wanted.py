"""Drawing until the map is good enough."""

from __future__ import annotations

import pytest

from tests.integration.known_cell import KNOWN, known_cell


@pytest.mark.long
def test_drawing_ends_with_the_round_that_is_good_enough(tmp_path):
    """0.5 mm is to be had by twelve circles; three rounds would be allowed."""
    with known_cell(tmp_path) as cell:
        cell.promote(KNOWN)
        table = cell.run("measure-table", touches=9)
        cell.promote(table.calibration_id)
        drawing = cell.run("draw", spots=12, rounds=3, wanted_mm=0.5)
        assert (drawing.verdict, drawing.reasons) == ("pass", [])
        circles = cell.circles(drawing.run_id).values()
        assert sum(circle["state"] == "drawn" for circle in circles) == 12
