"""The projector's full model from a table and held boards: a known truth, and planes too alike."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.calib.camera import CameraModel
from cellctl.calib.projector import LensPrior
from cellctl.calib.second_plane import FREE, LitPlane, full_projector
from cellctl.errors import SolveError
from cellctl.geometry import Transform, invert, look_down, pose_matrix, transform_points
from tests.calib.synthetic import CAMERA

LENS = CameraModel(
    np.array([[2976.0, 0.0, 962.0], [0.0, 2975.0, 1130.0], [0.0, 0.0, 1.0]]),
    np.array([0.02, -0.004, 0.0, 0.0, 0.0]),
    (1920, 1080),
)
PRIOR = LensPrior(1.55 * 1920, np.array([960.0, 1134.0]))
WORLD_CAMERA = Transform("world", "camera", look_down((0.0, -0.4, 0.8), (0.01, -0.43, 0.0)))
WORLD_PROJECTOR = Transform("world", "projector", look_down((0.02, -0.75, 1.3), (0.0, -0.72, 0.0)))
TABLE = pose_matrix((0.001, -0.001, 0.0), (0.0, -0.44, 0.0))
BOARDS = (
    pose_matrix((0.2, 0.1, 0.3), (0.03, -0.42, 0.12)),
    pose_matrix((-0.2, 0.15, 0.0), (-0.05, -0.45, 0.25)),
)


def lit(name: str, plane, half: float, rng: np.random.Generator, noise: float = 0.15) -> LitPlane:
    x = np.linspace(-half, half, 16)
    flat = np.stack([*np.meshgrid(x, x), np.zeros((16, 16))], axis=-1).reshape(-1, 3)
    points = transform_points(plane, flat)
    shown = LENS.project(WORLD_PROJECTOR.inverse().apply(points))
    seen = CAMERA.project(WORLD_CAMERA.inverse().apply(points))
    inside = ((shown > 0) & (shown < (1919, 1079))).all(axis=1)
    shown = shown + rng.normal(0, noise, shown.shape)
    pose = invert(WORLD_CAMERA.matrix) @ plane
    return LitPlane(name, shown[inside], seen[inside], pose)


def planes(count: int = 2) -> list[LitPlane]:
    rng = np.random.default_rng(1)
    held = [lit(f"b{i}", pose, 0.08, rng) for i, pose in enumerate(BOARDS[:count])]
    return [lit("table", TABLE, 0.3, rng), *held]


def solve(seen: list[LitPlane]):
    return full_projector(seen, CAMERA, WORLD_CAMERA, LENS.image_size, PRIOR)


@pytest.mark.parametrize("count", [1, 2])
def test_truth_is_recovered(count):
    found = solve(planes(count))
    off = (found.lens.vector - LENS.vector)[list(FREE)]
    assert np.abs(off / found.sigma).max() < 4.5
    assert found.planes == ("table", "b0", "b1")[: count + 1]
    height = np.array([[0.05, -0.4, 0.15], [-0.1, -0.5, 0.3], [0.0, -0.45, 0.0]])
    truth = LENS.project(WORLD_PROJECTOR.inverse().apply(height))
    assert np.abs(found.project(height) - truth).max() < 0.5
    assert (found.held_out_px is None) == (count == 1)
    assert found.to_dict()["T_world_projector"]


def test_one_plane_is_not_enough():
    with pytest.raises(SolveError, match="none of them 30 mm off"):
        solve(planes(0))
    few = planes(1)
    few[1] = LitPlane("b0", few[1].projector_px[:5], few[1].camera_px[:5], few[1].T_camera_plane)
    with pytest.raises(SolveError, match="read on 1 planes"):
        solve(few)
    with pytest.raises(SolveError, match="read on 0 planes"):
        solve([])
