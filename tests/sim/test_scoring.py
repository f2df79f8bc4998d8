"""Scores: what the standard world calls the true error, through the door of truth."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.errors import BadInput
from cellctl.sim.grid import Grid
from cellctl.sim.presets import CR
from cellctl.sim.scoring import Scorer
from cellctl.sim.truth import draw
from tests.sim.worlds import world


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory):
    with world(tmp_path_factory.mktemp("scored"), seed=3) as running:
        yield running


@pytest.fixture(scope="module")
def truth():
    return draw(CR, 3)


@pytest.fixture(scope="module")
def grid(truth):
    return Grid(truth)


def test_the_grid_covers_110_percent_of_the_drawn_area(grid):
    points = grid.points
    assert points.shape == (121, 3)
    assert np.ptp(points[:, 0]) == pytest.approx(1.1 * 0.670)
    assert np.ptp(points[:, 1]) == pytest.approx(1.1 * 0.375)
    assert np.ptp(points[:, 2]) == 0
    assert points[:, :2].mean(axis=0) == pytest.approx((0.0, -0.44))


def test_drawing_joints_are_of_one_branch_and_exact(truth, grid):
    joints = grid.joints.reshape(11, 11, 6)
    for axis in (0, 1):
        assert np.abs(np.diff(joints, axis=axis)).max() < np.radians(25)
    tips = truth.nominal_arm.forward(grid.joints) @ (*truth.nominal_pen, 1.0)
    assert np.allclose(tips[:, :3], grid.points, atol=2e-6)


async def test_perfect_light_scores_zero_and_a_shift_scores_itself(endpoint, truth, grid):
    scorer = Scorer(endpoint)
    points = await scorer.grid()
    assert np.array_equal(points, grid.points)
    pen = truth.pen_lands(points[:, :2], grid.joints)
    pixels = truth.projector.project(pen)
    perfect = await scorer.score(pixels)
    assert perfect["true_mm"] < 1e-3
    assert perfect["true_px"] < 1e-3
    shifted = await scorer.score(pixels + (3.0, 4.0))
    assert shifted["true_px"] == pytest.approx(5.0, abs=1e-6)
    assert shifted["true_mm"] == pytest.approx(5.0 * 0.437, rel=0.05)
    await scorer.close()


async def test_the_robot_s_own_error_is_no_calibration_error(endpoint, truth, grid):
    """A world point is where the pen truly stands, a millimetre beside where it is reported."""
    scorer = Scorer(endpoint)
    naive = truth.projector.project(grid.points)
    score = await scorer.score(naive)
    assert 0.2 < score["true_mm"] < 5.0
    await scorer.close()


async def test_wrong_pixels_are_refused(endpoint):
    scorer = Scorer(endpoint)
    for pixels, words in (
        (np.zeros((5, 2)), "121 pixels"),
        (np.zeros((121, 3)), "pixels"),
        (np.full((121, 2), np.nan), "not finite"),
    ):
        with pytest.raises(BadInput, match=words):
            await scorer.score(pixels)
    assert await scorer.collisions() == []
    await scorer.close()
