"""The cell with the large robot: nothing assumes one arm, one camera or one table height."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cellctl import ik
from cellctl.calib.patterns import detect_markers
from cellctl.calib.targets import board_from_dict
from cellctl.config import load_config, parse_config
from cellctl.geometry import pose_matrix
from cellctl.motion import Guard, guard_of
from cellctl.sim.bodies import bodies, plate_points
from cellctl.sim.cell_config import cell_document, to_toml
from cellctl.sim.contact import Obstacles
from cellctl.sim.grid import Grid, drawing_joints
from cellctl.sim.optics import Renderer
from cellctl.sim.presets import IR
from cellctl.sim.robot import Arm
from cellctl.sim.textures import description
from cellctl.sim.truth import draw
from cellctl.sim.view import Plate
from tests.sim.scenes import board_pixels, marker_corners, still
from tests.sim.test_motion import LIMITS

CONFIG_FILE = Path(__file__).parents[2] / "config" / "sim-ir.toml"
HOME = np.radians(IR.home_deg)
UP = pose_matrix((0.0, 0.0, 0.0), (0.9, 0.2, 1.9))
"""The flange points up, and so do its boards, between table and camera."""


@pytest.fixture(scope="module")
def truth():
    return draw(IR, 1)


@pytest.fixture(scope="module")
def guard():
    return guard_of(parse_config(cell_document(IR, 1), "generated"))


@pytest.fixture(scope="module")
def posture(truth, guard):
    """Boards over the table, facing the camera."""
    starts = ik.random_starts(truth.nominal_arm, 40, seed=0)
    found = ik.solutions(truth.nominal_arm, UP[None], HOME, starts)[0]
    return found[guard.free(found)][0]


@pytest.fixture(scope="module")
def picture(truth, posture):
    return Renderer(1, IR.camera).picture(truth, still(truth.arm.link_frames(posture)), "large")


def test_the_shipped_file_is_the_generated_one():
    assert CONFIG_FILE.read_text(encoding="utf-8") == to_toml(cell_document(IR, 0))
    config = load_config(CONFIG_FILE)
    assert config.cell.id == "sim-ir"
    assert config.camera.image_size_px == (3840, 2160)


def test_its_camera_sees_the_boards_where_they_are(truth, posture, picture):
    flange = truth.arm.link_frames(posture)[6]
    assert picture.shape == (2160, 3840)
    for name in truth.boards:
        board = board_from_dict(description(name, IR.boards), name)
        found = board.detect(picture)
        assert found is not None
        expected = board_pixels(truth, name, flange, found.points[:, :2])
        assert len(found.ids) == len(board.points)
        assert np.abs(found.pixels - expected).max() < 0.5


def test_its_printed_markers_are_not_taken_for_projected_ones(picture):
    """The camera sees far beyond the light: the parked arm's boards are in its pictures."""
    assert detect_markers(picture) == {}


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


@pytest.mark.parametrize("seed", range(8))
def test_its_guard_lets_the_arm_stand_at_home(seed):
    guard = guard_of(parse_config(cell_document(IR, seed), "generated"))
    assert guard.first_violation(HOME) is None


@pytest.mark.parametrize("yaw", [0.0, 30.0, -30.0, 90.0, -90.0])
def test_the_pen_reaches_all_that_is_drawn_in(truth, guard, yaw):
    """Straight down, at several yaw angles; nothing but the pen's tip is near the table."""
    steps = np.linspace(-1.0, 1.0, 3)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    spots = grid * np.array(IR.table.area_m) / 2 + IR.table.centre_m[:2]
    starts = np.vstack([HOME, ik.random_starts(guard.arm, 12, seed=0)])
    poses = truth.drawing_pose(spots, guard.scene.table_height, np.radians(yaw))
    for found in ik.solutions(guard.arm, poses, HOME, starts):
        assert may_draw(guard, found).any()


def test_the_scored_drawing_posture_is_allowed(truth, guard):
    spots = np.array([IR.table.centre_m[:2]]) + [[0.0, 0.0], [0.375, 0.55], [-0.375, -0.55]]
    assert may_draw(guard, drawing_joints(truth, spots, guard.scene.table_height)).all()


def may_draw(guard: Guard, joints: np.ndarray) -> np.ndarray:
    """Which of joints (n, 6) break no rule but that the pen stays off the table."""
    broken = np.zeros(len(joints), dtype=bool)
    for rule in guard.rules(joints):
        pen = np.array(rule.who) == "pen"
        drawing = pen & (rule.what == "comes too near to the table")
        broken |= (rule.broken & ~drawing).any(axis=1)
    return ~broken


@pytest.mark.parametrize("seed", range(3))
def test_hulls_contain_what_its_arm_truly_carries(seed):
    document = cell_document(IR, seed)
    hulls = [document["bracket"][name]["hull"] for name in ("checkerboard", "markers")]
    for body in bodies(draw(IR, seed)):
        if isinstance(body.shape, Plate):
            for point in plate_points(body.shape, 0.02):
                assert any(
                    (np.array(h["min_m"]) < point).all() and (point < np.array(h["max_m"])).all()
                    for h in hulls
                ), (body.name, point)


def test_boards_that_face_forwards_look_along_the_pen(truth):
    for name, board in truth.boards.items():
        assert np.allclose(board.pose.rotation[:, 2], (0.0, 0.0, -1.0))
        corner = board.pose.apply([*marker_corners(IR.boards, 0)[0], 0.0])
        assert corner[2] == pytest.approx(IR.boards.tray_m), name
