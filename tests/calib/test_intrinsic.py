"""Intrinsics: the truth recovered, honest standard deviations, bad views named."""

from __future__ import annotations

import random
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cellctl.calib.camera_fit import CameraOption, fit_camera
from cellctl.calib.chain import Sheet
from cellctl.calib.intrinsic import IntrinsicLimits, judge, solve_intrinsic
from cellctl.calib.views import View, rms
from cellctl.errors import BadInput, SolveError
from tests.calib.synthetic import BOARD, CAMERA, board_poses, views

SIZE = CAMERA.image_size
LIFT = Sheet.of(BOARD.points).lift(BOARD.points)[:, 0]
BENT = np.column_stack([BOARD.points[:, :2], 3e-4 * LIFT])
"""The board's corners when it is bent by 0.3 mm along its length."""


def test_without_noise_the_truth_is_found():
    result = solve_intrinsic(views(0, noise=0.0), SIZE)
    assert np.allclose(result.camera.vector, CAMERA.vector, rtol=1e-6, atol=1e-6)
    assert result.held_out_px < 1e-6
    assert judge(result) == ("pass", ())


def test_the_optimum_is_opencvs():
    seen = views(1)
    ours = solve_intrinsic(seen, SIZE, warp=False)
    theirs = cv2.calibrateCamera(
        [view.points.astype(np.float32) for view in seen],
        [view.pixels.astype(np.float32) for view in seen],
        SIZE,
        np.eye(3),
        np.zeros(5),
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14),
    )
    assert ours.rms_px == pytest.approx(theirs[0], rel=1e-5)
    assert np.allclose(ours.camera.K, theirs[1], atol=0.02)


def test_predicted_deviations_are_those_of_repeated_solves():
    """The errors of twenty calibrations, in the standard deviations that each predicts."""
    option = CameraOption(warp=False)
    fits = [fit_camera(views(seed, count=8), SIZE, option)[0] for seed in range(20)]
    scores = np.array([(fit.camera.vector - CAMERA.vector) / fit.sigma for fit in fits])
    spread = np.sqrt(np.mean(scores**2, axis=0))
    assert ((spread > 0.55) & (spread < 1.5)).all(), spread


def test_a_bent_board_is_noticed_and_does_not_bias_the_focal_length():
    bent = [views(seed, count=10, points=BENT) for seed in (2, 3)]
    flat = [solve_intrinsic(seen, SIZE, warp=False) for seen in bent]
    best = [solve_intrinsic(seen, SIZE) for seen in bent]
    assert all(np.abs(r.camera.vector[0] - CAMERA.vector[0]) > 1.5 for r in flat)
    assert all(np.abs(r.camera.vector[0] - CAMERA.vector[0]) < 1.0 for r in best)
    assert all(abs(r.warp[0] - 3e-4) < 5e-5 for r in best)
    assert all(b.held_out_px < f.held_out_px for b, f in zip(best, flat, strict=True))


def test_a_flat_board_is_left_flat():
    assert (
        sum(bool(solve_intrinsic(views(seed, count=8), SIZE).warp.any()) for seed in range(3)) <= 1
    )


def test_held_out_is_leave_one_out():
    """The figure is what one gets by hand: solve without a view, fit its pose, measure."""
    seen = views(4, count=6)
    result = solve_intrinsic(seen, SIZE, warp=False)
    errors = []
    for left_out in seen:
        rest = [view for view in seen if view is not left_out]
        camera = solve_intrinsic(rest, SIZE, warp=False).camera
        _, turn, shift = cv2.solvePnP(left_out.points, left_out.pixels, camera.K, camera.distortion)
        turn, shift = cv2.solvePnPRefineLM(
            left_out.points, left_out.pixels, camera.K, camera.distortion, turn, shift
        )
        back, _ = cv2.projectPoints(left_out.points, turn, shift, camera.K, camera.distortion)
        errors.append(back.reshape(-1, 2) - left_out.pixels)
    assert result.held_out_px == pytest.approx(rms(np.concatenate(errors)), rel=1e-4)
    assert result.held_out_px > result.rms_px


def test_the_order_of_the_views_does_not_matter():
    seen = views(5, count=8)
    shuffled = random.Random(0).sample(seen, len(seen))
    assert solve_intrinsic(seen, SIZE).to_dict() == solve_intrinsic(shuffled, SIZE).to_dict()


def test_bad_views_are_rejected_by_name():
    seen = views(6, count=14)
    rng = np.random.default_rng(0)
    smeared = replace(seen[3], pixels=seen[3].pixels + rng.normal(0, 2.0, seen[3].pixels.shape))
    wrong = replace(seen[8], pixels=rng.uniform(0, 1000, seen[8].pixels.shape))
    few = replace(seen[11], points=seen[11].points[:4], pixels=seen[11].pixels[:4])
    line = replace(seen[12], points=seen[12].points[:9], pixels=seen[12].pixels[:9])
    bad = {"v03": smeared, "v08": wrong, "v11": few, "v12": line}
    result = solve_intrinsic([bad.get(view.id, view) for view in seen], SIZE)
    reasons = {r.id: r.reason for r in result.rejected}
    assert reasons.keys() == bad.keys()
    assert "reprojection error" in reasons["v03"]
    assert "only 4 points" in reasons["v11"]
    assert "one line" in reasons["v12"]
    assert np.abs(result.camera.vector[:4] - CAMERA.vector[:4]).max() < 1.5
    assert result.held_out_used_px < 0.2 < result.held_out_px


def test_a_rejected_view_counts_by_its_share_and_not_by_its_error():
    seen = views(6, count=14)
    noise = np.random.default_rng(0).normal(0, 8.0, (54, 2))
    seen[3] = replace(seen[3], pixels=seen[3].pixels + noise)
    result = solve_intrinsic(seen, SIZE)
    assert [r.id for r in result.rejected] == ["v03"]
    assert result.held_out_px > IntrinsicLimits().held_out_px > result.held_out_used_px
    assert judge(result) == ("pass", ())


def test_too_few_views_say_so():
    with pytest.raises(SolveError, match=r"2 usable views .* at least 3"):
        solve_intrinsic(views(7, count=2), SIZE)


def test_views_without_tilt_fail_and_say_what_is_missing():
    result = solve_intrinsic(views(8, count=8, tilt_deg=(0.0, 1.0)), SIZE)
    verdict, reasons = judge(result)
    assert verdict == "fail"
    assert any("tilted by 20-45 degrees" in reason for reason in reasons)


def test_limits_are_limits():
    result = solve_intrinsic(views(9, count=8), SIZE)
    limits = IntrinsicLimits(views=30, held_out_px=0.01, coverage=0.99)
    verdict, reasons = judge(result, limits)
    assert verdict == "fail"
    assert len(reasons) == 3


def test_an_id_twice_is_bad_input():
    seen = views(10, count=4)
    with pytest.raises(BadInput, match="'v00' is used more than once"):
        solve_intrinsic([*seen, seen[0]], SIZE)


def test_no_distortion_means_none():
    result = solve_intrinsic(views(11), SIZE, distortion=False, warp=False)
    assert not result.camera.distortion.any()
    assert not result.sigma[4:].any()


def test_nonsense_is_refused():
    rng = np.random.default_rng(1)
    garbage = [View(str(i), BOARD.points, rng.uniform(0, 1000, (54, 2))) for i in range(5)]
    with pytest.raises(SolveError, match="no pinhole camera explains the views"):
        solve_intrinsic(garbage, SIZE)


def test_a_board_too_small_for_single_precision_is_no_crash():
    """Zhang's closed form, OpenCV's, gives up; the common focal lengths do not need it."""
    tiny = [replace(view, points=1e-20 * view.points) for view in views(13, count=6)]
    result = solve_intrinsic(tiny, SIZE, warp=False)
    assert result.held_out_used_px < 3.0


def test_all_boards_are_where_they_were():
    seen = views(12, count=8, noise=0.05)
    truth = board_poses(np.random.default_rng(12), 8, (15.0, 45.0))
    result = solve_intrinsic(seen, SIZE)
    for view in result.views:
        assert np.abs(view.pose[:3, 3] - truth[int(view.id[1:])][:3, 3]).max() < 3e-3
