"""The table of the published pipeline, on the simulated cell's true geometry."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.calib.calibration import Plane
from cellctl.calib.projector import LensPrior
from cellctl.calib.stages import CellData, Stage, solve_stages
from tests.calib.numeric_cell import NumericCell, numeric_cell

NAMES = [
    "no distortion model",
    "factory K, D; homography on raw pixels",
    "calibrated K, D; homography on raw pixels",
    "undistorted before the homography, closed-form hand-eye (Park)",
    "hand-eye by reprojection",
    "projector radial distortion",
]


@pytest.fixture(scope="module")
def cell() -> NumericCell:
    return numeric_cell(3, intrinsic=14, hand_eye=10)


@pytest.fixture(scope="module")
def stages(cell: NumericCell) -> list[Stage]:
    preset = cell.truth.preset.projector
    data = CellData(
        intrinsic=cell.intrinsic,
        hand_eye=cell.hand_eye,
        pictures=cell.pictures,
        centres=cell.centres,
        factory=cell.factory,
        table=Plane.horizontal(cell.table_height),
        lens=LensPrior(preset.throw_ratio * preset.size_px[0], np.array(preset.centre_px)),
    )
    return solve_stages(data)


def test_rows_are_named_as_in_the_paper(stages):
    assert [stage.name for stage in stages] == NAMES


def test_each_stage_is_what_its_name_says(stages):
    cameras = [stage.calibration.camera for stage in stages]
    assert not cameras[0].distortion.any()
    assert [stage.calibration.raw_pixels for stage in stages] == [False, True, True] + [False] * 3
    assert all((c.vector == cameras[2].vector).all() for c in cameras[3:])
    poses = [stage.calibration.T_world_camera.matrix for stage in stages]
    assert (poses[2] == poses[3]).all()
    assert (poses[4] == poses[5]).all()
    assert not (poses[3] == poses[4]).all()
    assert [stage.calibration.projector.radial.any() for stage in stages] == [False] * 5 + [True]


def test_the_maps_get_better_from_stage_to_stage(stages):
    held_out = [stage.held_out_px for stage in stages]
    assert held_out[2] > 3 * held_out[3] > 3 * held_out[5]
    assert all(s.training_px <= s.held_out_px for s in stages)


def test_light_lands_better_from_stage_to_stage(cell, stages):
    """True millimetres between light and pen. Single cells differ; the ends of the table do not."""
    true_mm = [cell.score(s.calibration.project(cell.grid))["true_mm"] for s in stages]
    assert true_mm[0] > 4.0
    assert 1.0 < true_mm[1] < 4.0
    assert max(true_mm[3:]) < 2.0
    assert true_mm[5] < 1.2
    assert true_mm[5] < true_mm[1]


def test_located_points_are_where_they_are_projected(cell, stages):
    for stage in stages:
        back = stage.calibration.locate(stage.calibration.project(cell.grid))
        assert np.abs(back - cell.grid).max() < 1e-6
