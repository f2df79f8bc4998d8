"""The projector map: truth recovered, one plane insisted on, held out by picture."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.patterns import marker_pictures
from cellctl.calib.projector import (
    LensPrior,
    ProjectorLimits,
    judge,
    judge_turn,
    shift_px,
    solve_projector,
    turned_deg,
)
from cellctl.calib.projector_map import ProjectorMap, direct_linear_transform
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import invert, look_down, transform_points
from tests.calib.synthetic import CAMERA

H = np.array([[2300.0, 40.0, 980.0], [-30.0, 2250.0, 560.0], [0.08, -0.11, 1.0]])
TRUTH = ProjectorMap(H, np.array([966.0, 1128.0]), 2976.0, np.array([0.02, -0.004]))
LENS = LensPrior(2976.0, np.array([960.0, 1134.0]))
PICTURES = marker_pictures((1920, 1080))
CENTRES = {number: centre for picture in PICTURES for number, centre in picture.centres.items()}


def seen(noise: float = 0.05, seed: int = 0, truth: ProjectorMap = TRUTH):
    """Camera pixels of all markers, picture by picture."""
    rng = np.random.default_rng(seed)
    found = []
    for picture in PICTURES:
        xy = truth.locate(np.array(list(picture.centres.values())))
        pixels = CAMERA.project(np.column_stack([xy, np.ones(len(xy))]))
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        found.append(dict(zip(picture.centres, pixels, strict=True)))
    return found


@given(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3))
def test_the_map_goes_both_ways(x, y):
    xy = np.array([x, y])
    assert np.abs(TRUTH.locate(TRUTH.project(xy)) - xy).max() < 1e-9


def test_json_keeps_every_digit():
    again = ProjectorMap.from_dict(json.loads(json.dumps(TRUTH.to_dict())))
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    assert (again.project(xy) == TRUTH.project(xy)).all()


def test_without_noise_the_truth_is_found():
    result = solve_projector(seen(noise=0.0), CENTRES, CAMERA, lens=LENS)
    xy = np.random.default_rng(1).uniform(-0.35, 0.35, (50, 2)) * (1, 0.6)
    assert np.abs(result.map.project(xy) - TRUTH.project(xy)).max() < 0.02
    assert result.rms_px < 0.01
    assert len(result.used) == 240


def test_the_lens_is_seen_and_its_centre_stays_near_the_prior():
    result = solve_projector(seen(), CENTRES, CAMERA, lens=LENS)
    plain = solve_projector(seen(), CENTRES, CAMERA)
    assert result.held_out_px < 0.6 * plain.held_out_px
    assert result.map.radial[0] == pytest.approx(0.02, abs=0.008)
    assert np.abs(result.map.centre - LENS.centre_px).max() < 30
    assert judge(result) == ("pass", ())


def test_held_out_is_leave_one_picture_out():
    pictures = seen(seed=2)
    result = solve_projector(pictures, CENTRES, CAMERA)
    errors = []
    for k, left_out in enumerate(pictures):
        rest = solve_projector(pictures[:k] + pictures[k + 1 :], CENTRES, CAMERA).map
        xy = CAMERA.normalise(np.array(list(left_out.values())))
        errors.append(rest.project(xy) - [CENTRES[i] for i in left_out])
    expected = np.sqrt(np.mean(np.square(np.concatenate(errors)).sum(axis=1)))
    assert result.held_out_px == pytest.approx(expected, rel=1e-4)


def test_of_one_picture_blocks_are_held_out():
    result = solve_projector(seen()[:1], CENTRES, CAMERA)
    assert len(result.used) == 60
    assert result.held_out_px > result.rms_px


def test_the_same_answer_in_any_order():
    pictures = [dict(reversed(list(p.items()))) for p in seen()]
    first = solve_projector(seen(), CENTRES, CAMERA, lens=LENS)
    second = solve_projector(pictures, CENTRES, CAMERA, lens=LENS)
    assert first.to_dict() == second.to_dict()


def test_a_few_markers_elsewhere_are_rejected_by_id():
    pictures = seen()
    for number in list(pictures[1])[:6]:
        pictures[1][number] = pictures[1][number] + (14.0, -9.0)
    bad = set(list(pictures[1])[:6])
    result = solve_projector(pictures, CENTRES, CAMERA, lens=LENS)
    assert {int(r.id) for r in result.rejected} == bad
    assert all("off the table's plane" in r.reason for r in result.rejected)
    assert result.held_out_used_px < 0.3 < result.held_out_px
    assert judge(result)[0] == "pass"


def test_two_surfaces_are_refused():
    """A board lies in the beam: a third of the markers are seen on a plane of its own."""
    other = ProjectorMap(H @ np.diag([1.05, 1.05, 1.0]), TRUTH.centre, 2976.0, TRUTH.radial)
    pictures, elsewhere = seen(), seen(truth=other)
    for k, picture in enumerate(pictures):
        for number in picture:
            if number % 20 < 7:
                picture[number] = elsewhere[k][number]
    with pytest.raises(SolveError, match=r"several surfaces: 1.. on one plane, .. on another"):
        solve_projector(pictures, CENTRES, CAMERA)


def test_a_mirrored_picture_is_refused():
    mirrored = ProjectorMap.pinhole(H @ np.diag([-1.0, 1.0, 1.0]))
    with pytest.raises(SolveError, match="mirrored"):
        solve_projector(seen(truth=mirrored), CENTRES, CAMERA)


def test_a_picture_upside_down_is_fine():
    turned = ProjectorMap.pinhole(H @ np.diag([-1.0, -1.0, 1.0]))
    assert solve_projector(seen(truth=turned), CENTRES, CAMERA).held_out_px < 0.3


def test_too_few_markers_say_so():
    with pytest.raises(SolveError, match="only 5 projected markers"):
        solve_projector([dict(list(seen()[0].items())[:5])], CENTRES, CAMERA)


def test_scattered_markers_are_no_plane():
    rng = np.random.default_rng(3)
    pictures = [{i: rng.uniform(100, 900, 2) for i in picture} for picture in seen()]
    with pytest.raises(SolveError, match="lie on one plane"):
        solve_projector(pictures, CENTRES, CAMERA)


def test_shift_is_robust():
    before = seen(noise=0.03)[0]
    after = {i: p + (0.5, 0.0) for i, p in seen(noise=0.03, seed=5)[0].items()}
    assert shift_px(before, before) == 0
    assert shift_px(before, after) == pytest.approx(0.5, abs=0.03)
    for number in list(after)[:10]:
        after[number] = after[number] + 50.0
    assert shift_px(before, after) < 0.6
    result = solve_projector(seen(), CENTRES, CAMERA, lens=LENS)
    verdict, reasons = judge(result, shift=0.5)
    assert verdict == "fail"
    assert "was touched" in reasons[0]


def test_shift_needs_the_same_markers():
    before = seen()[0]
    with pytest.raises(SolveError, match="only 3 of 60"):
        shift_px(before, dict(list(before.items())[:3]))


def test_limits_are_limits():
    result = solve_projector(seen(), CENTRES, CAMERA, lens=LENS)
    limits = ProjectorLimits(markers=500, used=1.1, held_out_px=1e-3)
    assert len(judge(result, limits)[1]) == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"H": [[1, 0], [0, 1]]}, "H must be finite and of the shape"),
        ({"H": np.zeros((3, 3)).tolist()}, "invertible"),
        ({"focal_px": -1}, "positive"),
        ({"radial": "none"}, "radial"),
        ({"centre_px": [0, float("inf")]}, "centre"),
    ],
)
def test_nonsense_is_named(change, words):
    with pytest.raises(BadInput, match=f"file.*{words}"):
        ProjectorMap.from_dict({**TRUTH.to_dict(), **change}, "file")


def test_dlt_is_exact():
    rng = np.random.default_rng(4)
    source = rng.uniform(-1, 1, (3, 6, 2))
    target = ProjectorMap.pinhole(H).project(source)
    assert np.allclose(direct_linear_transform(source, target), H / H[2, 2], rtol=1e-9)


def test_upside_down_against_the_config_is_named():
    """Half a turn of the picture is a good map all the same, of another mounting."""
    over = look_down(np.array([0.0, -0.44, 1.3]), np.array([0.05, -0.4, 0.0]))
    camera = look_down(np.array([0.02, -0.45, 0.8]), np.array([0.0, -0.44, 0.0]), yaw=0.5)
    spot = np.array([0.0, -0.44, 0.0])
    table = spot + 0.2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    seen_at = transform_points(invert(camera), table)
    lit = transform_points(invert(over), table)
    for flip, named in ((1.0, False), (-1.0, True)):
        pixels = flip * LENS.focal_px * lit[:, :2] / lit[:, 2:] + LENS.centre_px
        found = direct_linear_transform(seen_at[:, :2] / seen_at[:, 2:], pixels)
        turn = turned_deg(ProjectorMap.pinhole(found), camera, over, LENS, spot=spot)
        assert abs(turn) == pytest.approx(180.0 if named else 0.0, abs=0.1)
        assert ("upside down" in " ".join(judge_turn(turn))) == named
