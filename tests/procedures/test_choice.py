"""Sets of views: about_camera keeps an unknown board scale out of a closed-form hand-eye."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cellctl.calib.closed_form import closed_form
from cellctl.geometry import invert, pose_matrix
from cellctl.procedures.choice import DEPTH_WEIGHT, about_camera
from cellctl.procedures.rig import PlannedView

COUNT = 10


def views(seed: int, count: int = 30) -> list[PlannedView]:
    """Boards before a camera, anywhere in its picture and tilted at random."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        about, spin = rng.uniform(0, 2 * np.pi, 2)
        tilt = np.radians(rng.uniform(20, 45)) * np.array([np.cos(about), np.sin(about), 0.0])
        turn = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", spin)
        place = rng.uniform((-0.25, -0.15, 0.35), (0.25, 0.15, 0.6))
        poses.append(pose_matrix(turn.as_rotvec(), place))
    return [PlannedView(pose, np.zeros(6)) for pose in poses]


def shift_m(chosen: list[PlannedView], scale: float) -> float:
    """How far a board larger by `scale` than stated shifts Park's camera, depth counting less."""
    X = pose_matrix((np.pi, 0.0, 0.0), (0.1, -0.4, 0.8))
    Y = pose_matrix((0.1, 0.2, 1.0), (0.2, 0.0, 0.08))
    boards = np.array([view.T_camera_board for view in chosen])
    A = X @ boards @ invert(Y)
    seen = boards.copy()
    seen[:, :3, 3] /= scale
    solved, _ = closed_form("park", A, seen)
    x, y, z = (invert(X) @ solved)[:3, 3]
    return float(np.hypot(x, y) + DEPTH_WEIGHT * abs(z))


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_scale_shifts_the_camera_less(seed):
    many = views(seed)
    picked = about_camera(many, COUNT, seed=0)
    assert sorted(map(id, picked)) == sorted(map(id, many))
    rng = np.random.default_rng(1)
    others = [[many[i] for i in rng.permutation(len(many))[:COUNT]] for _ in range(20)]
    typical = np.median([shift_m(other, 1.004) for other in others])
    assert shift_m(picked[:COUNT], 1.004) < 0.7 * typical


def test_the_same_choice_every_time():
    one, two = (about_camera(views(5), COUNT, seed=3) for _ in range(2))
    assert [v.T_camera_board.tobytes() for v in one] == [v.T_camera_board.tobytes() for v in two]


def test_with_few_views_all_are_taken():
    assert len(about_camera(views(0, 4), COUNT, seed=0)) == 4


def test_motions_about_one_axis_are_no_failure():
    turns = [pose_matrix((0.0, 0.0, a), (0.0, 0.0, 0.5)) for a in np.linspace(0, 2, 12)]
    flat = [PlannedView(turn, np.zeros(6)) for turn in turns]
    assert len(about_camera(flat, COUNT, seed=0)) == 12
