"""The camera model: both ways, to rounding; nonsense is named."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.camera import CameraModel
from cellctl.errors import BadInput

K = np.array([[915.0, 0.0, 958.0], [0.0, 914.0, 548.0], [0.0, 0.0, 1.0]])
D = np.array([0.085, -0.060, 0.0005, -0.0004, 0.012])
SIZE = (1920, 1080)


def random_points(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.3, 2.0, (200, 1))
    return np.concatenate([rng.uniform(-0.9, 0.9, (200, 2)) * z, z], axis=1)


def test_projects_as_opencv_does():
    points = random_points(0)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)
    assert np.allclose(CameraModel(K, D, SIZE).project(points), expected.reshape(-1, 2), atol=1e-9)


@given(
    st.floats(-0.25, 0.25),
    st.floats(-0.05, 0.05),
    st.floats(-0.003, 0.003),
    st.floats(0, 1919),
    st.floats(0, 1079),
)
def test_normalise_inverts_projection(k1, k2, p1, x, y):
    camera = CameraModel(K, np.array([k1, k2, p1, -p1, 0.0]), SIZE)
    xy = camera.normalise(np.array([x, y]))
    if np.isfinite(xy).all():
        assert np.abs(camera.project(np.append(xy, 1.0)) - (x, y)).max() < 1e-8
    else:  # the picture's edge lies beyond where the distortion folds back
        r = np.linspace(0, 4, 4001)
        warped = r * (1 + r**2 * (k1 + r**2 * k2))
        folds = np.flatnonzero(np.diff(warped) <= 0)
        assert len(folds)
        assert warped[folds[0]] < np.linalg.norm(camera.plane(np.array([x, y]))) + 0.05


def test_five_iterations_of_opencv_would_not_do():
    corner = np.array([[[0.0, 0.0]]])
    ours = CameraModel(K, np.array([-0.3, 0.1, 0, 0, 0]), SIZE)
    rough = cv2.undistortPoints(corner, ours.K, ours.distortion)[0, 0]
    back = ours.project(np.append(rough, 1.0))
    assert np.abs(back).max() > 0.01
    assert np.abs(ours.project(np.append(ours.normalise(corner[0, 0]), 1.0))).max() < 1e-9


def test_beyond_the_fold_there_is_no_answer():
    camera = CameraModel(K, np.array([-0.4, 0.0, 0, 0, 0]), SIZE)
    assert np.isnan(camera.normalise(np.array([6000.0, 548.0]))).all()


def test_points_behind_have_no_picture():
    assert np.isnan(CameraModel(K, D, SIZE).project(np.array([0.1, 0.1, -1.0]))).all()


def test_derivatives_are_those_of_the_projection():
    camera, points, step = CameraModel(K, D, SIZE), random_points(1), 1e-6
    pixels, by_point, by_intrinsics = camera.jacobians(points)
    assert np.allclose(pixels, camera.project(points))
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (camera.project(points + shift) - camera.project(points - shift)) / (2 * step)
        assert np.allclose(by_point[..., axis], slope, rtol=1e-6, atol=1e-4)
    for i in range(9):
        moved = [
            CameraModel.from_vector(camera.vector + s * np.eye(9)[i], SIZE) for s in (1e-5, -1e-5)
        ]
        slope = (moved[0].project(points) - moved[1].project(points)) / 2e-5
        assert np.allclose(by_intrinsics[..., i], slope, rtol=1e-5, atol=1e-4)


def test_half_the_resolution_keeps_pixel_centres():
    camera = CameraModel(K, D, SIZE)
    half = camera.scaled((960, 540))
    point = np.array([0.3, -0.2, 1.0])
    assert np.allclose(half.project(point), (camera.project(point) + 0.5) / 2 - 0.5)


def test_cropped_pictures_are_refused():
    with pytest.raises(BadInput, match="different shapes"):
        CameraModel(K, D, SIZE).scaled((1280, 1080))


def test_json_keeps_every_digit():
    camera = CameraModel(K * np.array([[1 / 3], [1 / 7], [1.0]]), D / 3, SIZE)
    again = CameraModel.from_dict(json.loads(json.dumps(camera.to_dict())))
    assert (again.vector == camera.vector).all()
    assert again.image_size == camera.image_size


@pytest.mark.parametrize(
    ("K", "D", "size", "words"),
    [
        (np.eye(2), D, SIZE, "shape"),
        ([[915, 1, 958], [0, 914, 548], [0, 0, 1]], D, SIZE, "must be"),
        ([[-915, 0, 958], [0, 914, 548], [0, 0, 1]], D, SIZE, "positive"),
        (np.full((3, 3), np.nan), D, SIZE, "not finite"),
        ("camera", D, SIZE, "numbers"),
        (K, [0.1], SIZE, "coefficients"),
        (K, [0.1, "x", 0, 0, 0], SIZE, "numbers"),
        (K, D, (1920.5, 1080), "image_size"),
        (K, D, (1920, -1), "image_size"),
        (K, D, 1920, "image_size"),
    ],
)
def test_nonsense_is_named(K, D, size, words):
    with pytest.raises(BadInput, match=words):
        CameraModel(K, D, size)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(json_values, json_values, json_values, st.booleans())
def test_whatever_is_read_is_a_camera_or_bad_input(first, second, size, valid_model):
    model = "plumb_bob" if valid_model else first
    value = {"K": first, "distortion": {"model": model, "coefficients": second}, "image_size": size}
    for candidate in (first, value, {**value, "distortion": second}):
        with pytest.raises(BadInput, match="file"):
            CameraModel.from_dict(candidate, "file")
