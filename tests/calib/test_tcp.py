"""The tool's tip from poses about one point: recovered truth, honest covariance, named faults."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from cellctl.calib.tcp import PivotLimits, judge, solve_tip, weakest_tilt
from cellctl.errors import BadInput, CellctlError, SolveError
from cellctl.geometry import Array, pose_matrix

TIP = np.array([0.012, -0.034, 0.187])
POINT = np.array([0.42, -0.31, 0.02])


def poses(count: int = 8, *, tilt_deg: float = 30.0, noise_m: float = 0.0, seed: int = 0) -> Array:
    """(n, 4, 4) with the tip on the point: tilted about all directions, and turned."""
    rng = np.random.default_rng(seed)
    made = []
    for i in range(count):
        about = 2.0 * np.pi * i / count + 0.3
        tilt = np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0])
        turn = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)])
        flange = POINT - turn.apply(TIP) + rng.normal(0, noise_m, 3)
        made.append(pose_matrix(turn.as_rotvec(), flange))
    return np.array(made)


@pytest.mark.parametrize("count", [4, 5, 8, 20])
def test_the_tip_is_recovered(count):
    result = solve_tip(poses(count))
    assert np.allclose(result.tip, TIP, atol=1e-10)
    assert np.allclose(result.point, POINT, atol=1e-10)
    assert result.rms_mm < 1e-6
    assert result.held_out_mm < 1e-6
    assert not result.rejected
    assert judge(result)[0] == "pass"


def test_covariance_is_the_scatter_of_repeated_solves():
    results = [solve_tip(poses(noise_m=2e-4, seed=seed)) for seed in range(300)]
    tips = np.array([result.tip for result in results]) - TIP
    mean = np.mean([result.covariance for result in results], axis=0)
    scatter = tips.T @ tips / len(tips)
    assert np.sqrt(scatter.diagonal() / mean.diagonal()) == pytest.approx([1.0] * 3, abs=0.12)
    held_out = np.mean([result.held_out_mm for result in results])
    assert held_out > np.mean([result.rms_mm for result in results])
    assert held_out == pytest.approx(0.2 * np.sqrt(3.0), rel=0.5)
    assert np.mean([bool(result.rejected) for result in results]) < 0.03


def test_the_held_out_error_is_that_of_solving_without_the_pose():
    all_poses = poses(7, noise_m=2e-4)
    result = solve_tip(all_poses)
    for i, pose in enumerate(result.poses):
        rest = solve_tip(np.delete(all_poses, i, axis=0))
        tip = all_poses[i, :3, :3] @ rest.tip + all_poses[i, :3, 3]
        assert pose.held_out_mm == pytest.approx(1e3 * np.linalg.norm(tip - rest.point), rel=1e-6)


@pytest.mark.parametrize("count", [5, 6, 12])
def test_one_bad_pose_is_named_and_left_out(count):
    made = poses(count, noise_m=1e-4)
    made[3, :3, 3] += (0.004, -0.005, 0.003)
    names = [f"p{i}" for i in range(count)]
    result = solve_tip(made, names)
    assert [r.id for r in result.rejected] == ["p3"]
    assert "7." in result.rejected[0].reason or "6." in result.rejected[0].reason
    assert np.abs(result.tip - TIP).max() < 5e-4
    assert judge(result)[0] == "pass"


def test_with_four_poses_a_bad_one_fails_the_verdict():
    made = poses(4, noise_m=1e-4)
    made[3, :3, 3] += (0.004, -0.005, 0.003)
    verdict, reasons = judge(solve_tip(made))
    assert verdict == "fail"
    assert any("held-out error" in reason for reason in reasons)


def test_a_moving_point_fails_the_verdict():
    verdict, reasons = judge(solve_tip(poses(10, noise_m=4e-3)))
    assert verdict == "fail"
    assert any("held-out" in reason and "worst is pose" in reason for reason in reasons)


def test_turns_about_one_axis_do_not_do():
    about_z = [
        pose_matrix((0, 0, a), POINT - Rotation.from_rotvec((0, 0, a)).apply(TIP))
        for a in np.linspace(-2, 2, 8)
    ]
    with pytest.raises(SolveError, match=r"z axis .* 0\.0 degrees"):
        solve_tip(about_z)
    with pytest.raises(SolveError, match="the same rotation"):
        solve_tip([about_z[0]] * 6)


@pytest.mark.parametrize("tilt_deg", [3.0, 8.0])
def test_little_tilt_is_named(tilt_deg):
    result = solve_tip(poses(8, tilt_deg=tilt_deg, noise_m=5e-5))
    assert result.tilt_deg == pytest.approx(2 * tilt_deg, rel=0.1)
    verdict, reasons = judge(result)
    assert verdict == "fail"
    assert any("z axis" in r and f"{result.tilt_deg:.0f} degrees" in r for r in reasons)


def test_one_axis_with_little_tilt_is_found():
    """Turned about z and tilted about x only a little: z remains weak, whatever the turns."""
    turns = Rotation.from_euler(
        "ZX", [(a, 4.0 * (i % 2)) for i, a in enumerate(range(0, 360, 45))], degrees=True
    )
    axis, tilt = weakest_tilt(turns.as_matrix())
    assert np.abs(axis) == pytest.approx([0, 0, 1], abs=0.06)
    assert np.degrees(tilt) < 10.0


def test_json_form():
    result = solve_tip(poses(6, noise_m=1e-4))
    value = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert value["tip"] == result.tip.tolist()
    assert value["poses"]["used"] == ["1", "2", "3", "4", "5", "6"]
    assert value["per_pose"]["2"]["residual_mm"] == result.poses[1].residual_mm


def test_limits_are_the_callers():
    result = solve_tip(poses(6, noise_m=1e-4))
    assert judge(result, PivotLimits(poses=10))[0] == "fail"
    assert judge(result, PivotLimits(sigma_mm=0.01))[0] == "fail"


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (np.zeros((0, 4, 4)), SolveError, "0 poses"),
        (poses(3), SolveError, "3 poses"),
        (np.full((5, 4, 4), np.nan), BadInput, "pose 1"),
        (poses(5)[:, :3], BadInput, "pose 1 must be a 4x4 matrix"),
        (2.0 * poses(5), BadInput, "not rigid"),
        (7, BadInput, "list of 4x4"),
        (None, BadInput, "list of 4x4"),
    ],
)
def test_bad_input_is_named(value, error, words):
    with pytest.raises(error, match=words):
        solve_tip(value)


def test_ids_must_fit():
    with pytest.raises(BadInput, match="different ids"):
        solve_tip(poses(5), ["a"] * 5)


@settings(max_examples=60)
@given(hnp.arrays(np.float64, st.tuples(st.integers(0, 7), st.just(6)), elements=st.floats(-4, 4)))
def test_whatever_poses_come(vectors):
    try:
        result = solve_tip([pose_matrix(v[:3], v[3:]) for v in vectors])
    except CellctlError:
        return
    assert np.isfinite(result.tip).all()
    verdict, reasons = judge(result)
    assert (verdict == "pass") == (not reasons)
    json.dumps(result.to_dict(), allow_nan=False)
