"""A calibration scored on views that it never saw, and set-ups that it says nothing about."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cellctl.calib.hand_eye import solve_hand_eye
from cellctl.calib.intrinsic import solve_intrinsic
from cellctl.calib.score import score_camera, score_hand_eye
from cellctl.calib.targets import Chessboard
from cellctl.cli.app import main
from cellctl.errors import BadInput
from cellctl.geometry import Transform, pose_matrix
from cellctl.scoring import solve_and_score
from tests.calib.render import homography, picture
from tests.calib.synthetic import BOARD as CHESS
from tests.calib.synthetic import CAMERA, robot_views, views

SIZE = (640, 480)
BOARD = Chessboard((7, 5), 0.03)
TILTS = ((20.0, 0.0), (-20.0, 15.0), (5.0, -30.0), (30.0, 20.0), (-10.0, -25.0), (25.0, -15.0))


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> Path:
    """Data sets `a` and `b`, half of the pictures each."""
    folder: Path = tmp_path_factory.mktemp("sets")
    for name in ("a", "b"):
        (folder / name).mkdir()
    for i, tilt in enumerate(TILTS):
        H = homography(BOARD, SIZE, 0.42, tilt, 25.0 * i, focal=500.0)
        cv2.imwrite(str(folder / "ab"[i % 2] / f"{i}.png"), picture(BOARD, H, SIZE, seed=i))
    write(folder / "a", (0, 2, 4))
    write(folder / "b", (1, 3, 5))
    return folder


def write(folder: Path, pictures: tuple[int, ...], **changes: Any) -> Path:
    document = {
        "format": "cellctl-dataset/1",
        "kind": "intrinsic",
        "image_size": list(SIZE),
        "board": BOARD.to_dict(),
        "views": [{"id": str(i), "image": f"{i}.png"} for i in pictures],
        **changes,
    }
    (folder / "dataset.json").write_text(json.dumps(document))
    return folder


def test_the_command_scores(sets, capsys):
    assert main(["solve", str(sets / "a"), "--score", str(sets / "b"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["views"]["used"] == ["0", "2", "4"]
    assert found["score"]["per_view_px"].keys() == {"1", "3", "5"}
    squares = [px**2 for px in found["score"]["per_view_px"].values()]
    assert found["score_px"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert 0.01 < found["score_px"] < 1.0


def test_pictures_that_were_seen_do_not_count(sets):
    for i in (0, 2):
        (sets / "b" / f"{i}.png").write_bytes((sets / "a" / f"{i}.png").read_bytes())
    plain = solve_and_score(sets / "a", sets / "b")
    more = solve_and_score(sets / "a", write(sets / "b", (0, 1, 2, 3, 5)))
    assert more["score_px"] == plain["score_px"]
    assert [view["id"] for view in more["score"]["left_out"]] == ["0", "2"]
    with pytest.raises(BadInput, match="has not seen"):
        solve_and_score(sets / "a", write(sets / "b", (0, 2)))
    write(sets / "b", (1, 3, 5))


def test_without_an_answer_there_is_no_score(sets):
    found = solve_and_score(write(sets / "a", (0, 2)), sets / "b")
    assert (found["verdict"], found["score_px"]) == ("fail", None)
    write(sets / "a", (0, 2, 4))


EYE = np.eye(4).tolist()
VIEW = {"id": "1", "image": "1.png", "T_base_flange": EYE}


@pytest.mark.parametrize(
    ("ours", "theirs", "words"),
    [
        ({}, {"image_size": [320, 240]}, "its image_size is 320x240, not 640x480"),
        ({}, {"kind": "hand-eye", "mount": "eye-in-hand"}, "its kind is hand-eye, not intrinsic"),
        (
            {"kind": "hand-eye", "mount": "eye-to-hand"},
            {"kind": "hand-eye", "mount": "eye-in-hand"},
            "its mount is eye-in-hand, not eye-to-hand",
        ),
        (
            {"kind": "hand-eye", "mount": "eye-to-hand"},
            {"kind": "hand-eye", "mount": "eye-to-hand", "board": CHESS.to_dict()},
            "its board is",
        ),
        ({}, {"kind": "projector-graycode"}, "projector-graycode"),
    ],
)
def test_another_set_up_is_named(sets, tmp_path, ours, theirs, words):
    for name, changes in (("a", ours), ("b", theirs)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.png").write_bytes((sets / "b" / "1.png").read_bytes())
        write(tmp_path / name, (1,), views=[VIEW], **changes)
    with pytest.raises(BadInput, match=words):
        solve_and_score(tmp_path / "a", tmp_path / "b")


def test_a_run_is_no_data_set(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(BadInput, match="a recorded run"):
        solve_and_score(tmp_path, tmp_path)


def test_a_score_of_noise_is_the_noise():
    seen, unseen = views(0, 12, noise=0.1), views(1, 8, noise=0.1)
    score = score_camera(solve_intrinsic(seen, CAMERA.image_size), unseen, same_board=True)
    # noise on both axes, less what six parameters of each pose take up
    assert score.px == pytest.approx(0.1 * np.sqrt(2 * (1 - 6 / 108)), rel=0.1)


@pytest.mark.parametrize("mount", ["eye-to-hand", "eye-in-hand"])
def test_hand_eye_is_scored_through_the_robot(mount):
    known = solve_hand_eye(robot_views(2, mount, count=8), mount, camera=CAMERA)
    unseen = robot_views(3, mount, count=5)
    good = score_hand_eye(known, unseen)
    assert good.px == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    off = pose_matrix((0, 0, 0), (0.0, 0.002, 0.0))
    moved = replace(known, board_pose=Transform("flange", "board", known.board_pose.matrix @ off))
    assert score_hand_eye(moved, unseen).px > 2.0


@pytest.mark.parametrize("by", [((0, 0, 0), (0.03, 0, 0)), ((0, 0, 0.1), (0, 0, 0))])
def test_a_board_that_sits_elsewhere_is_another_set_up(by):
    known = solve_hand_eye(robot_views(2, count=8), "eye-to-hand", camera=CAMERA)
    elsewhere = known.board_pose.matrix @ pose_matrix(*by)
    moved = replace(known, board_pose=Transform("flange", "board", elsewhere))
    with pytest.raises(BadInput, match="the board sits elsewhere"):
        score_hand_eye(moved, robot_views(3, count=5))


@pytest.mark.parametrize(
    ("name", "limit_px"),
    [("opencv_left_intr", 0.195), ("rct_charuco_e2h", 2.0), ("ur_charuco_eih", 0.7)],
)
def test_half_of_a_real_set_predicts_the_other(shared_data, tmp_path, name, limit_px):
    source = shared_data / name
    document = json.loads((source / "dataset.json").read_text())
    for half in (0, 1):
        folder = tmp_path / str(half)
        folder.mkdir()
        (folder / "images").symlink_to(source / "images")
        views = document["views"][half::2]
        (folder / "dataset.json").write_text(json.dumps({**document, "views": views}))
    found = solve_and_score(tmp_path / "0", tmp_path / "1")
    assert found["score_px"] < limit_px
    assert 0.5 * found["held_out_px"] < found["score_px"] < 1.5 * found["held_out_px"]
