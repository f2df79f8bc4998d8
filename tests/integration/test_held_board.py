"""A board held into the light: the projector's full model, right above the table as on it."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.calib.camera import CameraModel
from cellctl.geometry import Transform
from cellctl.sim.presets import PRESETS
from cellctl.sim.truth import draw
from tests.integration.known_cell import CAMERA_OFF_M, known_cell

MM_PER_PX = 0.43


@pytest.mark.long
def test_held_board(tmp_path):
    """10 cm above the table as good as on it, where the table's own map would be 9 mm off. What is
    left is how far off the camera was said to hang."""
    with known_cell(tmp_path) as cell:
        info = cell.run("projector", columns=10, rows=6, pictures=1, held=2)
        assert (info.verdict, info.reasons) == ("pass", [])
        lit = cell.samples(info.run_id, "lit")
    assert info.result is not None
    told = info.result["data"]["full_model"]
    print(told)
    assert len(told["planes"]) == 3
    for sample in lit.values():
        if not sample["flaw"]:
            assert len(sample["projector_px"]) == len(sample["camera_px"]) > 50
    truth = draw(PRESETS["cr"], 0)
    size = (told["size"][0], told["size"][1])
    lens = CameraModel(np.array(told["K"]), np.array(told["distortion"]["coefficients"]), size)
    found = Transform("world", "projector", told["T_world_projector"])
    x, y = np.meshgrid([-0.15, 0.0, 0.15], [-0.1, 0.0, 0.1])
    for height in (0.0, 0.1):
        points = truth.table.pose.apply(np.stack([x, y, 0 * x + height], axis=-1).reshape(-1, 3))
        off = lens.project(found.inverse().apply(points)) - truth.projector.project(points)
        off_mm = MM_PER_PX * off
        assert np.linalg.norm(off_mm.mean(axis=0)) < 1e3 * CAMERA_OFF_M
        off_mm -= off_mm.mean(axis=0)
        assert np.sqrt(np.square(off_mm).sum(axis=1).mean()) < 0.8
