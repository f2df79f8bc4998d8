"""Every usual mistake with hand-eye data is planted, and read by its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cellctl.calib.drift import find_drift
from cellctl.calib.hand_eye import HandEyeResult, judge, solve_hand_eye
from cellctl.calib.targets import Chessboard
from cellctl.calib.views import RobotView
from cellctl.errors import SolveError
from cellctl.geometry import Array, Transform, invert, pose_matrix, transform_points
from tests.calib.synthetic import CAMERA, X, Y, pixels, robot_views

MOUNTS = ("eye-to-hand", "eye-in-hand")
Views = list[RobotView]


def with_poses(views: Views, poses: list[Array]) -> Views:
    return [
        replace(view, T_base_flange=Transform("base", "flange", pose))
        for view, pose in zip(views, poses, strict=True)
    ]


def poses_of(views: Views) -> list[Array]:
    return [view.T_base_flange.matrix for view in views]


def shifted(views: Views) -> Views:
    poses = poses_of(views)
    return with_poses(views, [*poses[1:], poses[0]])


def shifted_back(views: Views) -> Views:
    poses = poses_of(views)
    return with_poses(views, [poses[-1], *poses[:-1]])


def reversed_poses(views: Views) -> Views:
    return with_poses(views, poses_of(views)[::-1])


def inverted(views: Views) -> Views:
    return with_poses(views, [invert(pose) for pose in poses_of(views)])


def transposed(views: Views) -> Views:
    poses = [pose.copy() for pose in poses_of(views)]
    for pose in poses:
        pose[:3, :3] = pose[:3, :3].T.copy()
    return with_poses(views, poses)


def in_millimetres(views: Views) -> Views:
    poses = [pose.copy() for pose in poses_of(views)]
    for pose in poses:
        pose[:3, 3] *= 1000.0
    return with_poses(views, poses)


def in_degrees(views: Views) -> Views:
    """Rotation vectors in degrees that were taken for radians."""
    return with_poses(
        views,
        [pose_matrix(np.degrees(v.T_base_flange.rvec), v.T_base_flange.translation) for v in views],
    )


def board_in_millimetres(views: Views) -> Views:
    return [replace(view, points=1000.0 * view.points) for view in views]


def mirrored(views: Views) -> Views:
    w, _ = CAMERA.image_size
    return [replace(view, pixels=view.pixels * (-1.0, 1.0) + (w - 1.0, 0.0)) for view in views]


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (shifted, "belongs to the picture after it.* shifted by one"),
        (shifted_back, "belongs to the picture before it.* shifted by one"),
        (reversed_poses, "reverse order"),
        (inverted, r"mount is .*; or, if the mount is right, the poses are inverted"),
        (transposed, "rotation is transposed"),
        (in_millimetres, "the poses seem to be in millimetres; state metres"),
        (in_degrees, "degrees taken for radians"),
        (board_in_millimetres, "the board's lengths seem to be in millimetres"),
        (mirrored, "the pictures are mirrored"),
    ],
)
def test_what_is_wrong_with_all_views_is_named(
    mount: Any, plant: Callable[[Views], Views], words: str
) -> None:
    seen = plant(robot_views(6, mount, count=8, robot=(0.2e-3, 0.02)))
    camera = None if plant is mirrored else CAMERA
    with pytest.raises(SolveError, match=words):
        solve_hand_eye(seen, mount, camera=camera, image_size=CAMERA.image_size)


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_wrong_mount_is_named(mount):
    seen = robot_views(6, mount, count=9, robot=(0.2e-3, 0.02))
    other: Any = MOUNTS[1 - MOUNTS.index(mount)]
    with pytest.raises(SolveError, match=f"the mount is {mount}, not {other}"):
        solve_hand_eye(seen, other, camera=CAMERA)


def test_a_shifted_list_says_of_each_view_whose_pose_it_has():
    with pytest.raises(SolveError) as caught:
        solve_hand_eye(shifted(robot_views(6, count=9)), "eye-to-hand", camera=CAMERA)
    views = caught.value.details["views"]
    assert len(views) == 9
    assert views["v03"] == "its picture fits the pose of view 'v02'"


def test_poses_that_belong_to_no_order_are_refused():
    seen = robot_views(6, count=9)
    mixed = [poses_of(seen)[i] for i in (3, 7, 0, 8, 1, 6, 2, 4, 5)]
    with pytest.raises(SolveError, match="do not belong together"):
        solve_hand_eye(with_poses(seen, mixed), "eye-to-hand", camera=CAMERA)


def rejected(result: HandEyeResult) -> dict[str, str]:
    return {r.id: r.reason for r in result.rejected}


@pytest.mark.parametrize("mount", MOUNTS)
def test_single_views_that_do_not_belong_are_explained(mount):
    """Two poses swapped, a pose from elsewhere, a pose of another view, a board half turned."""
    seen = robot_views(6, mount, count=13, robot=(0.2e-3, 0.02))
    poses = poses_of(seen)
    poses[1], poses[4] = poses[4], poses[1]
    poses[7] = poses[7] @ pose_matrix((0.3, -0.2, 0.4), (0.08, -0.05, 0.1))
    poses[9] = poses[10]
    middle = np.append(seen[0].points[:, :2].mean(axis=0), 0.0)
    half = pose_matrix((0, 0, np.pi), (0, 0, 0))
    half[:3, 3] = middle - half[:3, :3] @ middle
    fault = with_poses(seen, poses)
    fault[12] = replace(fault[12], pixels=fault[12].pixels[::-1])
    result = solve_hand_eye(fault, mount, camera=CAMERA)
    reasons = rejected(result)
    assert reasons.keys() == {"v01", "v04", "v07", "v09", "v12"}
    assert "exchanging the poses of views 'v01' and 'v04' would fit" in reasons["v01"]
    assert "exchanging the poses of views 'v04' and 'v01' would fit" in reasons["v04"]
    assert "fits no pose of the others" in reasons["v07"]
    assert "fits no pose of the others" in reasons["v09"]  # its own pose is nobody's now
    assert "the board was turned by half a turn" in reasons["v12"]
    assert np.linalg.norm(result.camera_pose.translation - X[:3, 3]) < 3e-3


@pytest.mark.parametrize(
    "scale",
    [
        0.5,
        pytest.param(0.8, marks=pytest.mark.long),
        1.06,
        pytest.param(2.0, marks=pytest.mark.long),
    ],
)
def test_another_board_is_measured_and_costs_no_view(scale):
    seen = [replace(v, points=v.points / scale) for v in robot_views(3, count=9)]
    result = solve_hand_eye(seen, "eye-to-hand", image_size=CAMERA.image_size)
    assert not result.rejected
    assert result.held_out_px < 0.3
    verdict, reasons = judge(result)
    assert verdict == "fail"
    stated, true = 30.0 / scale, result.scale * 30.0 / scale
    assert true == pytest.approx(30.0, abs=0.05)
    assert f"what should be {stated:.2f} mm seems to be {true:.2f} mm" in reasons[0]
    assert np.linalg.norm(result.camera_pose.translation - X[:3, 3]) < 3e-3


def test_a_board_numbered_from_its_other_end_is_named():
    board = Chessboard((9, 7), 0.03)
    rng = np.random.default_rng(0)
    seen = []
    for i, view in enumerate(robot_views(7, noise=0.0, count=8)):
        chain = invert(X) @ view.T_base_flange.matrix @ Y
        true = transform_points(board.symmetries[int(i in (2, 5))], board.points)
        found = pixels(chain, rng, 0.1, true)
        seen.append(RobotView(view.id, board.points, found, view.T_base_flange, board.symmetries))
    result = solve_hand_eye(seen, "eye-to-hand", camera=CAMERA)
    assert result.turned == ("v02", "v05")
    assert "turned by half a turn in views v02, v05" in " ".join(result.to_dict()["remarks"])


def moving(views: Views, share: Array) -> Views:
    """The flange creeps: by 4 mm and 0.2 deg when the share is one."""
    off = [pose_matrix((0, 0, np.radians(0.2) * s), (4e-3 * s, 0, 0)) for s in share]
    return with_poses(views, [p @ o for p, o in zip(poses_of(views), off, strict=True)])


@pytest.mark.parametrize(
    ("mount", "slips"),
    [("eye-to-hand", False), pytest.param("eye-in-hand", True, marks=pytest.mark.long)],
)
def test_drift_is_named_with_the_view_where_it_begins(mount, slips):
    seen = robot_views(1004, mount, count=12, robot=(0.2e-3, 0.02))
    i = np.arange(12)
    result = solve_hand_eye(moving(seen, 1.0 * (i >= 7) if slips else i / 11), mount, camera=CAMERA)
    assert result.drift is not None
    assert result.drift.since in ({"v07"} if slips else {"v00", "v01"})
    assert result.drift.jump == slips
    verdict, reasons = judge(result)
    assert verdict == "fail"
    words = "something slipped" if slips else "warming up"
    assert any(words in reason and repr(result.drift.since) in reason for reason in reasons)


NAMES = [f"v{i:02d}" for i in range(12)]
STILL = np.broadcast_to(np.eye(3), (12, 3, 3))


@pytest.mark.parametrize("start", [0, 4, 7])
def test_a_ramp_begins_where_it_begins(start):
    rng = np.random.default_rng(start)
    shifts = rng.normal(0, 1e-4, (12, 3))
    shifts[:, 1] += 3e-3 * np.maximum(np.arange(12) - start, 0) / (11 - start)
    found = find_drift(NAMES, rng.normal(0, 1e-4, (12, 3)), shifts, STILL)
    assert found is not None
    assert not found.jump
    assert abs(NAMES.index(found.since) - start) <= 1
    assert found.mm == pytest.approx(3.0, rel=0.2)


def test_noise_is_no_drift():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1e-3, (60, 2, 12, 3))
    found = [find_drift(NAMES, one[0], one[1], STILL) is not None for one in noise]
    assert sum(found) <= 3


def test_the_order_of_the_input_does_not_matter_even_to_faults():
    seen = robot_views(6, count=9, robot=(0.2e-3, 0.02))
    poses = poses_of(seen)
    poses[1], poses[4] = poses[4], poses[1]
    fault = with_poses(seen, poses)
    rng = np.random.default_rng(1)
    documents = {
        json.dumps(solve_hand_eye(views, "eye-to-hand", camera=CAMERA).to_dict())
        for views in (fault, [fault[i] for i in rng.permutation(9)], fault[::-1])
    }
    assert len(documents) == 1
