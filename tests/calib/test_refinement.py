"""The correction itself: there and back, its slopes, its files, and its place in a calibration."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellctl.calib.calibration import Calibration
from cellctl.calib.refinement import FAMILIES, Refinement
from cellctl.errors import BadInput
from tests.calib.test_calibration import calibration

RNG = np.random.default_rng(3)
H = np.array([[1.002, 0.001, 0.003], [-0.002, 0.998, -0.002], [0.001, -0.002, 1.0]])
NODES = RNG.uniform(-1, 1, (25, 2))


def of(family: str) -> Refinement:
    base = Refinement(family, np.array([0.02, -0.01]), 0.4, H)
    if family == "quadratic":
        return replace(base, polynomial=0.01 * RNG.normal(size=(3, 2)))
    if family == "cubic":
        return replace(base, polynomial=0.01 * RNG.normal(size=(7, 2)))
    if family in ("rbf", "thin-plate"):
        weights = 0.005 * RNG.normal(size=NODES.shape)
        return replace(base, kernel=family, length=0.7, nodes=NODES, weights=weights)
    return Refinement(family) if family == "none" else base


EVERY = [of(family) for family in FAMILIES]
inside = st.tuples(st.floats(-0.45, 0.45), st.floats(-0.45, 0.45))


@given(st.sampled_from(EVERY), inside)
def test_undo_is_the_inverse(refinement, point):
    xy = np.array([point])
    assert np.abs(refinement.undo(refinement.apply(xy)) - xy).max() < 1e-12
    assert np.abs(refinement.apply(refinement.undo(xy)) - xy).max() < 1e-12


@pytest.mark.parametrize("refinement", EVERY, ids=FAMILIES)
def test_slopes_are_those_of_the_map(refinement):
    xy, step = RNG.uniform(-0.4, 0.4, (20, 2)), 1e-6
    moves = np.eye(2) * step
    differences = [
        (refinement.apply(xy + move) - refinement.apply(xy - move)) / (2 * step) for move in moves
    ]
    slopes = refinement.slopes(refinement.scaled(xy))
    assert np.abs(np.stack(differences, axis=-1) - slopes).max() < 1e-7


@pytest.mark.parametrize("refinement", EVERY, ids=FAMILIES)
def test_files_keep_every_digit(refinement):
    again = Refinement.from_dict(json.loads(json.dumps(refinement.to_dict())))
    xy = RNG.uniform(-0.4, 0.4, (50, 2))
    assert (again.apply(xy) == refinement.apply(xy)).all()
    assert again.to_dict() == refinement.to_dict()


def test_none_is_the_identity():
    xy = RNG.uniform(-0.4, 0.4, (5, 2))
    assert (Refinement("none").apply(xy) == xy).all()
    assert (Refinement("none").undo(xy) == xy).all()


def test_what_has_no_inverse_is_not_a_number():
    fold = Refinement("quadratic", polynomial=np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]]))
    assert np.isnan(fold.undo(np.array([[-5.0, 0.0]]))).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"family": "quartic"}, "no family is called 'quartic'"),
        ({"family": None}, "no family"),
        ({"kernel": "wave"}, "no kernel is called 'wave'"),
        ({"scale": 0.0}, "positive"),
        ({"length": -1}, "positive"),
        ({"H": np.zeros((3, 3)).tolist()}, "invertible"),
        ({"H": [[1.0]]}, r"H must be finite and of the shape \(3, 3\)"),
        ({"centre": ["x", "y"]}, "centre is not made of numbers"),
        ({"centre": [float("nan"), 0.0]}, "centre must be finite"),
        ({"polynomial": [[0.0, 0.0]]}, "polynomial has 1 rows"),
        ({"nodes": [[0.0, 0.0]]}, "equally many"),
        ({"weights": [[0.0]]}, "weights must be finite"),
        ({"colour": "red"}, "needs exactly"),
    ],
)
def test_what_is_wrong_is_named(change, words):
    with pytest.raises(BadInput, match=f"active.json: .*{words}"):
        Refinement.from_dict({**of("affine").to_dict(), **change}, "active.json")


@given(st.recursive(st.none() | st.floats() | st.text(), lambda x: st.lists(x, max_size=3)))
@settings(max_examples=25)
def test_rubbish_is_bad_input(value):
    for name in of("affine").to_dict():
        try:
            Refinement.from_dict({**of("affine").to_dict(), name: value})
        except BadInput:
            continue


@given(st.sampled_from(EVERY), st.floats(300, 1600), st.floats(200, 900))
def test_a_refined_calibration_goes_there_and_back(refinement, x, y):
    cell, pixel = replace(calibration(), refinement=refinement), np.array([[x, y]])
    point = cell.locate(pixel)
    assert np.abs(cell.project(point) - pixel).max() < 1e-6
    bare = calibration()
    assert np.abs(bare.project(point) - pixel).max() > 0.01 or refinement.family == "none"


def test_a_refined_calibration_is_filed():
    cell = replace(calibration(), refinement=of("thin-plate"))
    text = json.dumps(cell.to_dict())
    again = Calibration.from_dict(json.loads(text))
    assert json.dumps(again.to_dict()) == text
    pixels = RNG.uniform(300, 900, (20, 2))
    assert (again.locate(pixels) == cell.locate(pixels)).all()


def test_calibrations_from_before_have_no_refinement():
    value = calibration().to_dict()
    del value["refinement"]
    assert Calibration.from_dict(value).refinement is None


def test_a_wrong_refinement_is_named_with_its_place():
    value = {**calibration().to_dict(), "refinement": {"family": "affine"}}
    with pytest.raises(BadInput, match=r"active\.json: refinement: needs exactly"):
        Calibration.from_dict(value, "active.json")


def test_raw_pixels_take_no_refinement():
    with pytest.raises(BadInput, match="undistorted"):
        replace(calibration(raw=True), refinement=of("affine"))


def test_the_table_is_a_homography_away():
    cell = calibration()
    xy = np.random.default_rng(0).uniform((-0.3, -0.6), (0.3, -0.3), (9, 2))
    pictured = np.column_stack([xy, np.ones(9)]) @ cell.table_homography.T
    slope = -cell.table.normal[:2] / cell.table.normal[2]
    z = cell.table.point[2] + (xy - cell.table.point[:2]) @ slope
    pixels = cell.project(np.column_stack([xy, z]))
    assert np.abs(cell.projector.project(pictured[:, :2] / pictured[:, 2:]) - pixels).max() < 1e-9
