"""Nothing assumes one arm, one camera or one table height: a cell with a large robot works too.

The preset here has the large cell's sizes but is only for this test.
"""

from __future__ import annotations

import numpy as np
import pytest

from cellctl import ik
from cellctl.config import parse_config
from cellctl.sim.cell_config import cell_document, to_toml
from cellctl.sim.contact import Obstacles
from cellctl.sim.grid import Grid
from cellctl.sim.optics import Renderer
from cellctl.sim.presets import (
    ArmErrors,
    BoardPreset,
    CameraPreset,
    Preset,
    ProjectorPreset,
    TablePreset,
)
from cellctl.sim.robot import Arm
from cellctl.sim.truth import draw
from tests.sim.scenes import board_pixels, find_markers, marker_corners, still
from tests.sim.test_motion import LIMITS

LARGE = Preset(
    name="large",
    arm="irb4600-60/2.05",
    arm_errors=ArmErrors(zero_sigma_deg=0.02, length_sigma_m=0.25e-3, twist_sigma_deg=0.01),
    camera=CameraPreset(
        size_px=(3840, 2160),
        focal_px=(1830.0, 1828.0),
        centre_px=(1916.0, 1096.0),
        height_m=4.0,
        tilt_deg=(6.0, 4.0),
        yaw_deg=90.0,
        factory_centre_off_px=4.0,
    ),
    projector=ProjectorPreset(throw_ratio=1.40, distance_m=3.3, yaw_deg=90.0),
    table=TablePreset(centre_m=(1.3, 0.0, 0.6), area_m=(0.75, 1.1), top_m=(1.1, 2.0)),
    boards=BoardPreset(
        inner_corners=(9, 6),
        square_m=0.060,
        markers=(3, 5),
        marker_m=0.080,
        pitch_m=0.100,
        clearance_m=0.15,
        tray_m=0.10,
        pen_m=0.25,
    ),
    home_deg=(90.0, 0.0, 20.0, 0.0, 70.0, 0.0),
)


@pytest.fixture(scope="module")
def truth():
    return draw(LARGE, 1)


@pytest.fixture(scope="module")
def posture(truth):
    """Boards over the table, facing the camera."""
    flange = truth.drawing_pose(np.array([[1.3, 0.0]]), 1.2, np.pi / 2)
    starts = ik.random_starts(truth.nominal_arm, 40, seed=0)
    return ik.solutions(truth.nominal_arm, flange, np.radians(LARGE.home_deg), starts)[0][0]


def test_its_camera_sees_the_boards_where_they_are(truth, posture):
    frames = truth.arm.link_frames(posture)
    picture = Renderer(1, LARGE.camera).picture(truth, still(frames), "large")
    assert picture.shape == (2160, 3840)
    found = find_markers(picture)
    assert len(found) >= 10
    for marker, quad in found.items():
        expected = board_pixels(truth, "markers", frames[6], marker_corners(LARGE.boards, marker))
        assert np.abs(quad - expected).max() < 1.0


def test_its_arm_moves_there_without_touching_anything(truth, posture):
    arm = Arm(truth, 0.0)
    end = arm.move(1.0, posture[None], LIMITS, "0")
    assert arm.collisions(end) == []
    assert np.abs(arm.read(end + 1.0).joints - posture).max() < 1e-3
    assert Obstacles(truth).nearest(arm.frames(np.array([end + 1.0]))[0]).gap > 0.02


def test_its_drawn_area_is_within_reach_and_scored_at_its_table(truth):
    grid = Grid(truth)
    assert grid.height == pytest.approx(0.6, abs=0.003)
    assert grid.joints.shape == (121, 6)


def test_its_config_is_one(truth):
    config = parse_config(cell_document(LARGE, 1), "large")
    assert config.camera.image_size_px == (3840, 2160)
    assert "sim-large" in to_toml(cell_document(LARGE, 1))
