"""Real pictures and real robot poses, against the best figures known for them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cellctl.calib.camera import CameraModel
from cellctl.errors import BadInput
from cellctl.geometry import rigid
from cellctl.offline import solve_dataset


@pytest.mark.parametrize(
    ("name", "known_px", "views"),
    [("opencv_left_intr", 0.18, 13), ("charuco_d435_intr", 0.50, 28)],
)
def test_intrinsic(shared_data, name, known_px, views):
    result = solve_dataset(shared_data / name)
    assert len(result["views"]["used"]) == views
    assert result["rms_px"] <= result["held_out_px"] <= known_px
    assert (result["verdict"], result["reasons"]) == ("pass", [])
    CameraModel.from_dict(result["camera"])


@pytest.mark.parametrize(
    ("name", "known_px", "transforms"),
    [
        ("rct_charuco_e2h", 1.28, ("T_base_camera", "T_flange_board")),
        ("ur_charuco_eih", 0.42, ("T_flange_camera", "T_base_board")),
    ],
)
def test_hand_eye(shared_data, name, known_px, transforms):
    """All views count, one with four corners of 24 by OpenCV's finder included."""
    result = solve_dataset(shared_data / name)
    assert not result["views"]["rejected"]
    assert result["held_out_px"] <= known_px
    assert (result["verdict"], result["reasons"]) == ("pass", [])
    closed = [c["held_out_px"] for n, c in result["candidates"].items() if n.startswith("closed")]
    assert result["held_out_px"] < 0.7 * min(closed)
    for transform in transforms:
        rigid(result[transform], transform)
    json.dumps(result)


def copied(source: Path, folder: Path, change: Any) -> Path:
    """The data set with its document changed; pictures are linked."""
    document = json.loads((source / "dataset.json").read_text())
    change(document)
    (folder / "images").symlink_to(source / "images")
    (folder / "dataset.json").write_text(json.dumps(document))
    return folder


def test_shuffled_and_mislabelled(shared_data, tmp_path):
    """Other order: the same to the last digit. Two pictures swapped: named, and not used."""
    source = shared_data / "ur_charuco_eih"
    for name in ("plain", "shuffled", "swapped"):
        (tmp_path / name).mkdir()

    def swap(document):
        first, second = document["views"][1], document["views"][4]
        first["image"], second["image"] = second["image"], first["image"]

    plain = solve_dataset(copied(source, tmp_path / "plain", lambda document: None))
    shuffled = solve_dataset(copied(source, tmp_path / "shuffled", lambda d: d["views"].reverse()))
    assert json.dumps(plain) == json.dumps(shuffled)
    swapped = solve_dataset(copied(source, tmp_path / "swapped", swap))
    reasons = {r["id"]: r["reason"] for r in swapped["views"]["rejected"]}
    assert "exchanging the poses of views '02' and '05' would fit" in reasons["02"]
    assert "exchanging the poses of views '05' and '02' would fit" in reasons["05"]
    apart = np.array(swapped["T_flange_camera"]) - np.array(plain["T_flange_camera"])
    assert np.linalg.norm(apart[:3, 3]) < 5e-3


def test_intrinsic_pictures_come_along(shared_data, tmp_path):
    """The camera from pictures of its own: here from the same ones, stated separately."""

    def separate(document):
        document["intrinsic_images"] = [
            {"id": view["id"], "image": view["image"]} for view in document["views"]
        ]
        document["intrinsic_image_size"] = document["image_size"]

    result = solve_dataset(copied(shared_data / "ur_charuco_eih", tmp_path, separate))
    assert (result["verdict"], result["reasons"]) == ("pass", [])
    assert result["held_out_px"] < 0.6
    assert not any("free camera" in name for name in result["candidates"])
    assert len(result["intrinsic"]["views"]["used"]) == 7
    assert result["intrinsic"]["rms_px"] <= result["intrinsic"]["held_out_px"] < 0.5
    assert any("add views with the board near" in r for r in result["intrinsic"]["remarks"])


def test_copies_of_pictures_change_nothing(shared_data, tmp_path):
    """Counted twice, a view would vouch for itself; five copies would outvote the others."""

    def copy(document):
        first = document["views"][0]
        document["views"] += [{**view, "id": f"{view['id']}b"} for view in document["views"]]
        document["views"] += [{**first, "id": f"z{i}"} for i in range(5)]

    source = shared_data / "ur_charuco_eih"
    plain, doubled = solve_dataset(source), solve_dataset(copied(source, tmp_path, copy))
    assert doubled["held_out_px"] == plain["held_out_px"]
    assert doubled["views"]["used"] == plain["views"]["used"]
    assert {r["reason"] for r in doubled["views"]["rejected"]} == {
        f"the same picture as view '{name}'" for name in plain["views"]["used"]
    }


def test_a_board_stated_wrong_is_bad_input(shared_data, tmp_path):
    wrong = {"inner_corners": [8, 6]}
    source = shared_data / "opencv_left_intr"
    folder = copied(source, tmp_path, lambda d: d["board"].update(wrong))
    with pytest.raises(
        BadInput, match=r"not seen in any picture.*goes on beyond 8x6 inner corners"
    ):
        solve_dataset(folder)


def test_the_other_pattern_is_a_failed_verdict(shared_data, tmp_path):
    source = shared_data / "ur_charuco_eih"
    folder = copied(source, tmp_path, lambda d: d["board"].update(legacy=True))
    result = solve_dataset(folder)
    assert result["verdict"] == "fail"
    assert "legacy is stated wrong; state the other value" in result["reasons"][0]
    assert len(result["views"]["rejected"]) == 7
    assert all("legacy" in view["reason"] for view in result["views"]["rejected"])


def test_mirrored_markers_are_named(shared_data, tmp_path):
    source = shared_data / "ur_charuco_eih"
    document = json.loads((source / "dataset.json").read_text())
    for view in document["views"]:
        image = cv2.imread(str(source / view["image"]), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(tmp_path / f"{view['id']}.png"), image[:, ::-1])
        view["image"] = f"{view['id']}.png"
    (tmp_path / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(BadInput, match="the pictures are mirrored"):
        solve_dataset(tmp_path)


def shifted(document: Any) -> None:
    poses = [view["T_base_flange"] for view in document["views"]]
    for view, pose in zip(document["views"], [*poses[1:], poses[0]], strict=True):
        view["T_base_flange"] = pose


def inverted(document: Any) -> None:
    for view in document["views"]:
        view["T_base_flange"] = np.linalg.inv(view["T_base_flange"]).tolist()


def other_mount(document: Any) -> None:
    mounts = ("eye-to-hand", "eye-in-hand")
    document["mount"] = mounts[1 - mounts.index(document["mount"])]


@pytest.mark.parametrize("name", ["rct_charuco_e2h", "ur_charuco_eih"])
@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (shifted, "shifted by one"),
        (inverted, "the poses are inverted"),
        (other_mount, "the mount is"),
    ],
)
def test_what_is_wrong_with_real_poses_is_named(shared_data, tmp_path, name, plant, words):
    result = solve_dataset(copied(shared_data / name, tmp_path, plant))
    assert result["verdict"] == "fail"
    assert any(words in reason for reason in result["reasons"])


def test_a_board_of_another_size_fails_and_says_so(shared_data, tmp_path):
    def larger(document):
        for key in ("square_m", "marker_m"):
            document["board"][key] *= 1.1

    source = shared_data / "ur_charuco_eih"
    plain, wrong = solve_dataset(source), solve_dataset(copied(source, tmp_path, larger))
    assert wrong["verdict"] == "fail"
    assert any("% smaller than stated" in reason for reason in wrong["reasons"])
    apart = np.array(wrong["T_flange_camera"]) - np.array(plain["T_flange_camera"])
    assert np.linalg.norm(apart[:3, 3]) < 1e-3
    assert wrong["camera"]["K"][0][0] == pytest.approx(plain["camera"]["K"][0][0], rel=2e-3)
