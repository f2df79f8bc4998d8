"""What the figures show is what was recorded."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.views import rms
from cellctl.geometry import pose_matrix
from cellctl.report import arrows, coverage, errors_of, odd, phrases, provenance, svg
from cellctl.report.recorded import read_recorded
from cellctl.report.stage_table import table_rows
from tests.report import samples


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / samples.RUN_ID
    return read_recorded(samples.write_run(folder, pictures=False))


@pytest.mark.parametrize(
    ("errors", "sigma_px"),
    [(errors_of.intrinsic_errors, 0.05), (errors_of.hand_eye_errors, 0.2)],
)
def test_residuals_are_the_noise_that_was_put_into_the_pixels(recorded, errors, sigma_px):
    found = errors(recorded)
    assert len(found) > 400
    assert rms(found) == pytest.approx(sigma_px * math.sqrt(2), rel=0.1)


def test_projector_residuals_are_the_noise_seen_through_the_map(recorded):
    places, errors = errors_of.projector_field(recorded)
    assert len(places) == 238
    per_camera_pixel = samples.LIGHT.H[0, 0] / samples.CAMERA.K[0, 0]
    assert rms(errors) == pytest.approx(0.07 * math.sqrt(2) * per_camera_pixel, rel=0.15)


def test_the_truth_stands_beside_the_row_that_it_belongs_to(recorded):
    assert [row["true_mm"] for row in table_rows(recorded)] == [v[2] for v in samples.ROWS.values()]


@given(st.floats(1.0, 80.0), st.floats(-179.0, 179.0), st.floats(-170.0, 170.0))
def test_tilt_lean_and_turn_of_a_pose(tilt, towards, turn):
    axis = np.radians(tilt) * np.array(
        [-np.sin(np.radians(towards)), np.cos(np.radians(towards)), 0.0]
    )
    spun = pose_matrix([0.0, 0.0, np.radians(turn)], [0.0, 0.0, 0.0])
    pose = pose_matrix(axis, [0.0, 0.0, 0.5]) @ spun
    found, lean, _ = coverage.angles(pose[None])
    assert found[0] == pytest.approx(tilt, abs=1e-6)
    away = (lean[0] - (towards + 180.0) + 180.0) % 360.0 - 180.0
    assert abs(away) < 1e-6
    assert coverage.angles(spun[None])[2][0] == pytest.approx(turn, abs=1e-6)


def test_steps_follow_each_other_over_the_run(recorded):
    bars = provenance.bars_of(recorded)
    steps = ["intrinsic/views", "hand-eye/views", "projector/pictures"]
    assert [bar.step for bar in bars][:3] == steps
    assert [bar.samples for bar in bars] == [24, 10, 4, 0, 60, 1]
    assert all(a.end == b.start for a, b in itertools.pairwise(bars))


@given(st.lists(st.floats(0.0, 50.0), min_size=1, max_size=20), st.floats(50.0, 2000.0))
def test_arrows_are_magnified_to_be_seen_and_to_stay_inside(lengths, per_metre):
    side = 400.0
    drawn = [arrows.Arrow("a", 0.0, 0.0, length, 0.0, held_out=False) for length in lengths]
    enlarged = arrows.magnification(drawn, per_metre, side)
    longest = max(lengths) * 1e-3 * per_metre * enlarged
    assert enlarged == 1 or longest <= arrows.FURTHEST * side * (1 + 1e-9)


# -- numbers


@given(st.floats(-1e9, 1e9), st.floats(1e-6, 1e9))
def test_ticks_are_round_numbers_inside(low, span):
    found = svg.ticks(low, low + span)
    assert len(found) <= 12
    slack = 1e-6 * span + 4 * np.spacing(max(abs(low), span))
    assert all(low - slack <= tick <= low + span + slack for tick in found)


@given(st.floats(1e-6, 1e3), st.floats(1.01, 1e6))
def test_log_ticks_are_inside(low, factor):
    found = svg.log_ticks(low, low * factor)
    assert all(low * 0.999 <= tick <= low * factor * 1.001 for tick in found)
    assert found or factor < 2.6


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.2123, "0.212"),
        (3.6, "3.60"),
        (23.71, "23.7"),
        (915.3, "915"),
        (0.0, "0.000"),
        (-0.31, "\N{MINUS SIGN}0.310"),
        (4.1e7, "4.10e+07"),
        (1e-6, "1.00e\N{MINUS SIGN}06"),
        (None, "\N{EN DASH}"),
        (float("nan"), "\N{EN DASH}"),
        (True, "\N{EN DASH}"),
        (10**400, "\N{EN DASH}"),
    ],
)
def test_figures_have_three_digits(value, text):
    assert phrases.figure(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(12.44, "12.4 s"), (99.97, "1 min 40 s"), (187, "3 min 07 s"), (4320, "1 h 12 min")],
)
def test_durations(seconds, text):
    assert phrases.duration(seconds) == text


LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text())
ANYTHING = st.recursive(
    LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=12
)


@given(ANYTHING)
def test_anything_can_be_read_as_anything(value):
    assert odd.points(value, 2).shape[1] == 2
    assert odd.text(value).encode().decode() == odd.text(value)
    assert isinstance(odd.texts(value), list)
    assert isinstance(odd.rows(value, "a"), list)
    assert isinstance(odd.mapping(value), dict)
    assert (odd.count(value) or 0) >= 0
