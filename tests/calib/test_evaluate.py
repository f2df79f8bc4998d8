"""Evaluation: the interval keeps its promise, and the words say what it is."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cellctl.calib.evaluate import evaluate, interval
from cellctl.errors import SolveError
from tests.soak.refinement import world

SIGMA = 0.17


def evaluated(differences: np.ndarray, freedom: float = 110.0, sigma: float = SIGMA):
    keys = [f"v{i}" for i in range(len(differences))]
    return evaluate(
        keys, differences / 0.43, differences, mark_sigma_mm=sigma, mark_freedom=freedom
    )


def test_the_error_is_the_papers():
    found = evaluated(np.array([[0.3, 0.4], [0.0, 0.0], [0.0, -0.5], [0.5, 0.0]]))
    assert found.held_out_mm == pytest.approx(np.sqrt(3 * 0.25 / 4))
    assert found.held_out_px == pytest.approx(found.held_out_mm / 0.43)
    low, high = found.held_out_ci_mm
    assert low < found.own_mm < found.held_out_mm < high
    assert found.held_out_ci_px == pytest.approx((low / 0.43, high / 0.43))
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["circles"] == 4
    assert document["per_circle"]["v0"]["mm"] == [0.3, 0.4]


def test_the_words_name_both_shares():
    found = evaluated(np.full((12, 2), 0.25))
    for words in ("12 circles", "0.35 mm", "scatters by 0.24 mm", "95 %"):
        assert words in found.meaning


@pytest.mark.parametrize("own", [0.0, 0.05, 0.15, 0.5, 3.0, 30.0])
@pytest.mark.parametrize("freedom", [8, 110])
def test_the_interval_holds_the_own_error_at_its_rate(own, freedom):
    """Errors that differ from place to place, and errors that are the same everywhere."""
    rng = np.random.default_rng(0)
    fixed = np.array([own / np.sqrt(2)] * 2)
    for everywhere in (False, True):
        hits = 0
        for _ in range(400):
            error = fixed if everywhere else rng.normal(0.0, own / np.sqrt(2), (12, 2))
            total = error + rng.normal(0.0, SIGMA, (12, 2))
            sigma = SIGMA * np.sqrt(rng.chisquare(freedom) / freedom)
            rms = float(np.sqrt(np.square(total).sum(axis=1).mean()))
            low, high = interval(rms, 12, sigma, freedom)
            assert low <= rms <= high
            hits += low <= own <= high
        assert hits >= 0.95 * 400 - 2 * np.sqrt(400 * 0.05 * 0.95)


def test_more_circles_say_more():
    widths = [np.diff(interval(0.8, n, SIGMA, 110))[0] for n in (6, 12, 24, 60)]
    assert widths == sorted(widths, reverse=True)
    assert interval(0.8, 12, SIGMA, 5)[0] < interval(0.8, 12, SIGMA, 110)[0]


def test_an_error_well_over_the_noise_is_not_hidden_by_it():
    low, high = interval(0.8, 12, SIGMA, 110)
    assert low > 0.5
    assert high < 1.2


def test_perfect_marks_are_no_division_by_zero():
    assert np.isfinite(evaluated(np.zeros((5, 2)), sigma=0.0).held_out_ci_mm).all()


def test_simulated_worlds_keep_the_stated_rate():
    """30 cells, each with a base calibration, 60 circles, a refinement, and 12 circles more.
    `python -m tests.soak.refinement` does 200."""
    found = [world(seed, families=("affine", "projective")) for seed in range(30)]
    for name in ("refined", "base"):
        assert sum(figures[f"{name}_covered"] for figures in found) >= 28
    assert np.median([figures["chosen"] for figures in found]) < 0.2
    assert np.median([figures["base_held_out"] for figures in found]) > 0.5


def test_bad_input_is_named():
    with pytest.raises(SolveError, match="only 3 circles to evaluate with"):
        evaluated(np.zeros((3, 2)))
    lost = np.zeros((5, 2))
    lost[2] = np.nan
    with pytest.raises(SolveError, match="the circle 'v2' lies where"):
        evaluated(lost)
