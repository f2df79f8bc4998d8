"""The joint adjustment: pose and table give way to the circles, as far as they were unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.refine import solve_refine
from cellctl.calib.refine_fit import Mark, Marks
from cellctl.geometry import Array, Transform, pose_matrix
from tests.calib.drawn import YAWS, DrawnCell, layout, quick_cell

COVARIANCE = np.diag([4e-4, 4e-4, 4e-4, 5e-4, 5e-4, 1e-3]) ** 2
"""Of turns (rad) and shifts (m) of the camera, about what a hand-eye leaves."""
PLAIN = ("none", "shift", "similarity", "joint", "affine", "projective")


@pytest.fixture(scope="module")
def cell() -> DrawnCell:
    return quick_cell(3)


def seen_by(truth: Calibration, cell: DrawnCell) -> list[Mark]:
    """60 circles without noise, as a cell would see them that is like `truth`."""
    xy = layout(cell.truth, np.random.default_rng(5))
    bare = [Mark(f"{i:03d}", p, float(YAWS[i % 3]), np.zeros(2)) for i, p in enumerate(xy)]
    seen = Marks.of(bare, truth).chain(np.array([1e-3, -5e-4]))
    return [replace(mark, seen=place) for mark, place in zip(bare, seen, strict=True)]


def moved(base: Calibration, pose: Array, height: float) -> Calibration:
    matrix = base.T_world_camera.matrix @ pose_matrix(pose[:3], pose[3:])
    table = Plane(base.table.point + [0.0, 0.0, height], base.table.normal)
    return replace(base, T_world_camera=Transform("world", "camera", matrix), table=table)


@pytest.mark.parametrize("seed", range(4))
def test_another_pose_and_height_are_found(cell, seed):
    """Two standard deviations away, the prior pulls by far less than a mark scatters."""
    pose = 2 * np.sqrt(COVARIANCE.diagonal()) * np.random.default_rng(seed).choice([-1, 1], 6)
    drawn = seen_by(moved(cell.base, pose, 5e-4), cell)
    result = solve_refine(drawn, cell.base, pose_covariance=COVARIANCE, families=["joint"])
    assert result.chosen == "joint"
    assert result.errors["training"].mm < 0.05
    assert result.refinement.family == "joint"


def test_what_is_known_exactly_does_not_move(cell):
    drawn = seen_by(moved(cell.base, np.array([1e-3, 0, 0, 0, 0, 0]), 0.0), cell)
    firm = solve_refine(drawn, cell.base, pose_covariance=1e-14 * np.eye(6), families=PLAIN)
    assert firm.candidate("joint").errors["training"].mm > 0.1
    loose = solve_refine(drawn, cell.base, pose_covariance=1e-2 * np.eye(6), families=PLAIN)
    assert loose.candidate("joint").errors["training"].mm < 1e-2


def test_it_needs_fewer_circles_than_the_free_homography(cell):
    rng = np.random.default_rng(0)
    marks = cell.marks(layout(cell.truth, rng)[:8], rng)
    result = solve_refine(marks, cell.base, pose_covariance=COVARIANCE, families=PLAIN)
    assert result.candidate("projective").refused
    joint = result.candidate("joint")
    assert joint.fit is not None
    assert cell.score(replace(cell.base, refinement=joint.fit.refinement)) < 0.35


def test_it_is_one_of_the_candidates_only_when_the_pose_is_known(cell):
    rng = np.random.default_rng(1)
    marks = cell.marks(layout(cell.truth, rng), rng)
    with_pose = solve_refine(marks, cell.base, pose_covariance=COVARIANCE, families=PLAIN)
    assert [c.name for c in with_pose.candidates] == list(PLAIN)
    assert cell.score(replace(cell.base, refinement=with_pose.refinement)) < 0.25
    without = solve_refine(marks, cell.base, families=PLAIN)
    assert "joint" not in [c.name for c in without.candidates]
