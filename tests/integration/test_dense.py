"""A Gray code on the simulated cell's table: a better map than from markers, and it can be solved
again from its pictures."""

from __future__ import annotations

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.offline import solve_folder
from cellctl.sim.presets import PRESETS
from cellctl.sim.truth import draw
from tests.integration.known_cell import KnownCell, known_cell


def map_error_px(cell: KnownCell, calibration_id: str | None) -> float:
    """By how many projector pixels the map from the camera's picture is off, all over the
    projector's own, where the camera sees it."""
    found: Calibration = cell.calibration(calibration_id)
    truth = draw(PRESETS["cr"], 0)
    w, h = truth.preset.projector.size_px
    x, y = np.linspace(40, w - 40, 30), np.linspace(40, h - 40, 20)
    shown = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = truth.camera.project(truth.light_lands(shown))
    inside = ((seen > 0) & (seen < np.array(truth.camera.lens.size))).all(axis=1)
    camera, _ = cell.camera()
    off = found.projector.project(camera.normalise(seen[inside])) - shown[inside]
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def test_dense(tmp_path):
    with known_cell(tmp_path) as cell:
        markers = cell.run("projector")
        dense = cell.run("projector", dense=True)
        assert (dense.verdict, dense.reasons) == ("pass", [])
        error = map_error_px(cell, dense.calibration_id)
        assert error < 0.08
        assert error < 0.8 * map_error_px(cell, markers.calibration_id)
        read = cell.samples(dense.run_id, "read")["code"]
        assert len(read["columns"]) + len(read["rows"]) >= 20000
        folder = tmp_path / "runs" / dense.run_id
    again = solve_folder(folder)
    assert (again["verdict"], again["reasons"]) == ("pass", [])
    assert again["held_out_px"] < 0.2
