"""The calibration object: there and back, raw baselines, files that keep every digit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.calibration import FORMAT, Calibration, Plane
from cellctl.calib.projector_map import ProjectorMap
from cellctl.errors import BadInput
from cellctl.geometry import Transform, look_down
from tests.calib.synthetic import CAMERA

H = np.array([[2300.0, 40.0, 980.0], [-30.0, 2250.0, 560.0], [0.08, -0.11, 1.0]])
MAP = ProjectorMap(H, np.array([966.0, 1128.0]), 2976.0, np.array([0.02, -0.004]))
POSE = Transform("world", "camera", look_down((0.02, -0.40, 0.8), (0.0, -0.44, 0.0)))
TILTED = Plane(np.array([0.0, -0.44, 0.01]), np.array([0.02, -0.01, np.sqrt(1 - 5e-4)]))
BOARDS = {"markers": Transform.from_rvec("flange", "markers", (1 / 3, 0, 0), (0.1, 1 / 7, 0))}


def calibration(raw: bool = False) -> Calibration:
    return Calibration(CAMERA, POSE, TILTED, MAP, BOARDS, raw)


@given(st.floats(0, 1919), st.floats(0, 1079), st.booleans())
def test_locate_and_project_undo_each_other(x, y, raw):
    cell, pixel = calibration(raw), np.array([[x, y]])
    point = cell.locate(pixel)
    assert abs(float((point[0] - TILTED.point) @ TILTED.normal)) < 1e-12
    assert np.abs(cell.project(point) - pixel).max() < 1e-6


def test_raw_pixels_see_the_lens():
    """The baseline pictures a point with distortion; both agree on the optical axis only."""
    on_axis = calibration().table.intersect(POSE.translation, POSE.rotation[:, 2][None])
    aside = POSE.apply(np.array([[0.3, 0.1, 0.8]]))
    raw, full = calibration(raw=True), calibration()
    assert np.abs(raw.project(on_axis) - full.project(on_axis)).max() < 1e-9
    assert np.abs(raw.project(aside) - full.project(aside)).max() > 1.0


def test_files_keep_every_digit():
    cell = calibration()
    text = json.dumps(cell.to_dict())
    again = Calibration.from_dict(json.loads(text))
    assert json.dumps(again.to_dict()) == text
    grid = np.random.default_rng(0).uniform(0, 1000, (20, 2))
    assert (again.locate(grid) == cell.locate(grid)).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "cellctl-calibration/2"}, "format must be 'cellctl-calibration/1'"),
        ({"camera": None}, "camera must be a dict"),
        ({"camera": {}}, "camera: needs K"),
        ({"T_world_camera": [[1]]}, "T_world_camera"),
        ({"T_world_camera": (2 * np.eye(4)).tolist()}, "T_world_camera"),
        ({"table": {"point": [0, 0, 0]}}, "table: missing key 'normal'"),
        ({"table": {"point": [0, 0, 0], "normal": [0, 0, 2]}}, "length 1"),
        ({"table": {"point": [0, 0], "normal": [0, 0, 1]}}, "point"),
        ({"projector": {"H": 1}}, "projector"),
        ({"boards": {"markers": 3}}, "boards"),
        ({"raw_pixels": 1}, "raw_pixels"),
        ({"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_what_is_wrong_is_named(change, words):
    with pytest.raises(BadInput, match=f"active.json: .*{words}"):
        Calibration.from_dict({**calibration().to_dict(), **change}, "active.json")


@pytest.mark.parametrize("value", [None, [], "x", {}])
def test_other_things_are_no_calibration(value):
    with pytest.raises(BadInput, match=FORMAT):
        Calibration.from_dict(value)


def test_a_missing_key_is_named():
    value = calibration().to_dict()
    del value["table"]
    with pytest.raises(BadInput, match="missing key 'table'"):
        Calibration.from_dict(value)
