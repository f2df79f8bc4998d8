"""Transforms: frames in the type, rigidity checked at the door."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cellctl.errors import BadInput, FrameError
from cellctl.geometry import Transform, invert, look_down

vectors = st.tuples(*[st.floats(-3, 3)] * 3)


@given(vectors, vectors, vectors)
def test_inverse_undoes(rvec, tvec, point):
    pose = Transform.from_rvec("world", "camera", rvec, tvec)
    assert np.allclose(pose.inverse().apply(pose.apply(np.array(point))), point, atol=1e-9)
    assert np.allclose((pose @ pose.inverse()).matrix, np.eye(4), atol=1e-9)


def test_wrong_order_raises_by_name():
    world_camera = Transform.identity("world", "camera")
    flange_board = Transform.identity("flange", "board")
    with pytest.raises(FrameError, match="'camera' and 'flange' differ"):
        world_camera @ flange_board


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(3), "4x4"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.diag([1.01, 1.0, 1.0, 1.0]), "not rigid"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrors"),
        (np.full((4, 4), np.nan), "not finite"),
        ("no", "not a matrix"),
        ([[10**400, 0, 0, 0], *np.eye(4)[1:].tolist()], "not a matrix of numbers: int too large"),
        ([["1.0", 0, 0, 0], *np.eye(4)[1:].tolist()], "not a matrix of numbers: it holds '1.0'"),
        ([[True, 0, 0, 0], *np.eye(4)[1:].tolist()], "not a matrix of numbers: it holds True"),
        ([[1, 0, 0, None], *np.eye(4)[1:].tolist()], "not a matrix of numbers: it holds None"),
    ],
)
def test_bad_matrix_is_named(matrix, words):
    with pytest.raises(BadInput, match=f"T_a_b.*{words}"):
        Transform("a", "b", matrix)


@pytest.mark.parametrize("decimals", [3, 4, 5])
def test_rounded_rotations_are_made_exact(decimals):
    """As teach pendants and log files print them, whatever the rotation."""
    exact = Rotation.random(300, np.random.default_rng(0)).as_matrix()
    for true in exact:
        matrix = np.eye(4)
        matrix[:3, :3] = np.round(true, decimals)
        rotation = Transform("a", "b", matrix).rotation
        assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
        assert np.abs(rotation - true).max() < 10.0**-decimals


def test_matrix_is_read_only():
    with pytest.raises(ValueError):
        Transform.identity("a", "b").matrix[0, 0] = 2


def test_look_down_sees_its_aim_on_the_optical_axis():
    pose = look_down((0.1, -0.4, 0.8), (0.0, -0.44, 0.0))
    aim = invert(pose) @ (0.0, -0.44, 0.0, 1.0)
    assert np.allclose(aim[:2], 0)
    assert aim[2] > 0.8
