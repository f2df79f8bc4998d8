"""Camera and projector adjusted together: a known truth, and captures that are not their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import Sheet
from cellctl.calib.procam import ProcamResult, judge, solve_procam
from cellctl.calib.procam_fit import LENS, plausible
from cellctl.calib.procam_problem import (
    Capture,
    Captures,
    Noise,
    Procam,
    ProcamFree,
    ProcamState,
)
from cellctl.errors import SolveError
from cellctl.geometry import pose_matrix, rotation_angle
from tests.calib.lit import (
    BOARD,
    CAMERA,
    POSES,
    PROJECTOR,
    T_PROJECTOR_CAMERA,
    Scene,
    board_pose,
)

MORE = (
    board_pose((0.3, 0.4, 0.4), (0.05, 0.0, 0.6)),
    board_pose((-0.3, -0.3, -0.5), (-0.05, 0.03, 0.85)),
    board_pose((0.5, -0.25, 0.2), (0.0, -0.04, 0.7)),
)
SIZES = CAMERA.image_size, PROJECTOR.image_size


def capture(
    name: str, scene: Scene, rng: np.random.Generator, corner: float, read: float
) -> Capture:
    """What a noisy corner finder and an almost exact reading yield."""
    turned = BOARD.points @ scene.pose[:3, :3].T + scene.pose[:3, 3]
    seen = scene.camera.project(turned) + rng.normal(0, corner, (len(turned), 2))
    steps = [scene.truth(seen + step) - scene.truth(seen - step) for step in 0.5 * np.eye(2)]
    shown = scene.truth(seen) + rng.normal(0, read, seen.shape)
    return Capture(name, BOARD.points, seen, shown, np.stack(steps, axis=-1))


def captures(
    seed: int = 0, count: int = 6, corner: float = 0.08, read: float = 0.02, **changes
) -> list[Capture]:
    rng = np.random.default_rng(seed)
    poses = (*POSES, *MORE)[:count]
    return [
        capture(f"c{i}", Scene(pose).without(**changes), rng, corner, read)
        for i, pose in enumerate(poses)
    ]


def solve(seen: list[Capture]) -> ProcamResult:
    return solve_procam(seen, *SIZES)


@pytest.fixture(scope="module")
def good() -> ProcamResult:
    return solve(captures())


def test_truth_is_recovered(good):
    assert judge(good) == ("pass", ())
    assert good.projector.K[1, 2] > PROJECTOR.image_size[1]
    for model, sigma, truth in (
        (good.camera, good.camera_sigma, CAMERA),
        (good.projector, good.projector_sigma, PROJECTOR),
    ):
        off = (model.vector - truth.vector)[list(LENS)] / sigma[list(LENS)]
        assert np.abs(off).max() < 4.5
    off = good.pose @ np.linalg.inv(T_PROJECTOR_CAMERA)
    assert rotation_angle(off) < 0.006
    assert np.linalg.norm(good.pose[:3, 3] - T_PROJECTOR_CAMERA[:3, 3]) < 0.004
    assert good.held_out_px < 0.15
    assert good.noise.camera == pytest.approx(0.08, rel=0.25)


@pytest.mark.long
def test_the_order_does_not_matter(good):
    again = solve(captures()[::-1])
    assert np.array_equal(again.projector.vector, good.projector.vector)
    assert again.used == good.used


def test_three_captures_and_two():
    """Three suffice; two give an answer that says what it lacks."""
    three = solve(captures(count=3))
    assert judge(three)[0] == "pass"
    assert three.projector.K[1, 2] == pytest.approx(PROJECTOR.K[1, 2], abs=6.0)
    two = solve(captures(count=2))
    assert "at least 3" in judge(two)[1][0]
    assert two.to_dict()["held_out_px"] is None
    with pytest.raises(SolveError, match="1 usable captures"):
        solve(captures(count=1))


@pytest.mark.long
def test_a_bent_board_is_noticed():
    rng, bent = np.random.default_rng(3), []
    warp = np.array([0.0012, -0.0009, 0.0005])
    for i, pose in enumerate((*POSES, *MORE)):
        points = BOARD.points.copy()
        points[:, 2] += Sheet.of(points).lift(points) @ warp
        in_camera = points @ pose[:3, :3].T + pose[:3, 3]
        seen = CAMERA.project(in_camera) + rng.normal(0, 0.04, (len(points), 2))
        flat = capture(f"c{i}", Scene(pose), rng, 0.0, 0.0)
        shown = PROJECTOR.project(
            in_camera @ T_PROJECTOR_CAMERA[:3, :3].T + T_PROJECTOR_CAMERA[:3, 3]
        )
        exact = seen - CAMERA.project(in_camera)
        shown = shown + (flat.slopes @ exact[..., None])[..., 0]
        bent.append(Capture(f"c{i}", BOARD.points, seen, shown, flat.slopes))
    assert solve(bent).warp == pytest.approx(warp, abs=2e-4)


def test_pixels_that_are_not_square():
    """A projector that stretches its input: the data win over what is usual."""
    stretched = CameraModel(
        PROJECTOR.K * np.array([[1.08], [1.0], [1.0]]), PROJECTOR.distortion, PROJECTOR.image_size
    )
    result = solve(captures(projector=stretched))
    fx, fy = result.projector.vector[:2]
    assert fx / fy == pytest.approx(1.08, rel=0.003)


def test_derivatives():
    seen = captures(count=3)
    free = ProcamFree(LENS, LENS, pose=True, warp=True)
    points = np.concatenate([c.points for c in seen])
    lenses = plausible(SIZES[0], 0.05), plausible(SIZES[1], None)
    k = len(BOARD.points)
    problem = Procam(
        Captures.of(seen), Sheet.of(points), free, *lenses, np.broadcast_to(np.eye(4), (3, k, 4, 4))
    )
    warp = np.array([3e-4, -2e-4, 1e-4])
    state = ProcamState(CAMERA, PROJECTOR, T_PROJECTOR_CAMERA, np.stack(POSES[:3]), warp)
    problem = problem.whitened_at(state, Noise(0.1, 0.03, 1e-3))
    at, priors = problem.linearise(state), problem.priors(state)
    assert np.allclose(at.residuals, problem.residuals(state))
    step = 1e-6
    for i in range(free.count):
        by = np.eye(free.count)[i] * step
        ends = [problem.retract(state, s * by, np.zeros((3, 6))) for s in (1, -1)]
        slope = (problem.residuals(ends[0]) - problem.residuals(ends[1])) / (2 * step)
        assert np.allclose(at.by_globals[..., i], slope, rtol=1e-4, atol=1e-3)
        told = (problem.priors(ends[0]).on_globals - problem.priors(ends[1]).on_globals) / 2e-6
        assert np.allclose(priors.globals_jacobian[:, i], told, rtol=1e-4, atol=1e-4)
    for i in range(6):
        by = np.tile(np.eye(6)[i] * step, (3, 1))
        ends = [problem.retract(state, np.zeros(free.count), s * by) for s in (1, -1)]
        slope = (problem.residuals(ends[0]) - problem.residuals(ends[1])) / (2 * step)
        assert np.allclose(at.by_locals[..., i], slope, rtol=1e-4, atol=1e-2)


def turned_over(one: Capture, across: bool) -> Capture:
    """The projector's picture flipped: left and right, else top and bottom."""
    axis = 0 if across else 1
    pixels, slopes = one.projector_px.copy(), one.slopes.copy()
    pixels[:, axis] = PROJECTOR.image_size[axis] - 1 - pixels[:, axis]
    slopes[:, axis] *= -1
    return replace(one, projector_px=pixels, slopes=slopes)


@pytest.mark.parametrize(("across", "word"), [(True, "mirrored"), (False, "upside down")])
def test_mirrored(across, word):
    seen = captures()
    with pytest.raises(SolveError, match=f"{word}.*negative focal length") as caught:
        solve([turned_over(one, across) for one in seen])
    assert [r["id"] for r in caught.value.details["rejected"]] == [one.id for one in seen]
    seen[2] = turned_over(seen[2], across)
    result = solve(seen)
    assert [r.id for r in result.rejected] == ["c2"]
    assert word in result.rejected[0].reason
    assert judge(result)[0] == "pass"


@pytest.mark.long
def test_half_a_turn_is_remarked():
    upside_down = [turned_over(turned_over(one, True), False) for one in captures()]
    result = solve(upside_down)
    assert "upside down" in result.to_dict()["remarks"][0]
    assert solve(captures()).to_dict()["remarks"] == []


def test_several_surfaces():
    """Of one capture a third was lit on something in front of the board."""
    seen = captures()
    left = BOARD.points[:, 0] < 0.07
    H = np.array([[1.0, 0.02, 30.0], [0.01, 1.03, -17.0]])
    shown = seen[3].projector_px.copy()
    shown[left] = np.column_stack([shown[left], np.ones(left.sum())]) @ H.T
    seen[3] = replace(seen[3], projector_px=shown)
    result = solve(seen)
    assert [r.id for r in result.rejected] == ["c3"]
    assert "several surfaces" in result.rejected[0].reason


def test_single_bad_points_do_no_harm(good):
    """Nor do they cost the capture."""
    seen = captures()
    shown = seen[1].projector_px.copy()
    shown[[3, 12, 20]] += [[40.0, 3.0], [-9.0, 12.0], [25.0, -25.0]]
    seen[1] = replace(seen[1], projector_px=shown)
    result = solve(seen)
    assert result.used == good.used
    assert np.abs(result.projector.vector - good.projector.vector)[:4].max() < 1.0


def test_too_few_inliers():
    seen = captures()
    rng = np.random.default_rng(5)
    garbage = replace(seen[0], projector_px=rng.uniform(0, 200, seen[0].projector_px.shape))
    few = seen[1][np.arange(len(BOARD.points)) < 9]
    result = solve_procam([garbage, few, *seen[2:]], *SIZES, seen={"c1": len(BOARD.points)})
    assert [r.id for r in result.rejected] == ["c0", "c1"]
    assert all("too few inliers" in r.reason for r in result.rejected)
    assert judge(result)[0] == "pass"


def test_a_mislabelled_capture():
    """The code of one capture with the corners of another; then with the projector moved."""
    seen = captures(count=4)
    other = captures(seed=9, count=4)
    seen[1] = replace(seen[1], projector_px=other[-1].projector_px, slopes=other[-1].slopes)
    result = solve(seen)
    assert [r.id for r in result.rejected] == ["c1"]
    assert "mislabelled" in result.rejected[0].reason
    moved = captures(seed=1, count=4)
    kicked = T_PROJECTOR_CAMERA @ pose_matrix((0.0, 0.02, 0.01), (0.01, 0.0, 0.0))
    moved[2] = captures(seed=1, count=4, T_projector_camera=kicked)[2]
    assert [r.id for r in solve(moved).rejected] == ["c2"]


@pytest.mark.long
def test_captures_that_are_alike():
    """The board always faces the camera: the focal lengths are not known, and that is said."""
    rng = np.random.default_rng(2)
    alike = [
        capture(f"c{i}", Scene(board_pose((0.0, 0.0, 0.1 * i), (0, 0, 0.75))), rng, 0.08, 0.02)
        for i in range(3)
    ]
    try:
        reasons = judge(solve(alike))[1]
    except SolveError as error:
        reasons = (error.message,)
    assert any("tilted" in reason for reason in reasons)
