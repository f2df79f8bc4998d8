"""Data sets: what is read, and every way in which a person may get one wrong."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cellctl.calib.observe import NOT_FOUND, Observed, observe, observe_with_robot
from cellctl.calib.targets import Chessboard
from cellctl.calib.views import View
from cellctl.dataset import load_dataset, read_picture
from cellctl.errors import BadInput
from cellctl.geometry import pose_matrix
from cellctl.offline import solve_dataset
from tests.calib.render import homography, picture

SIZE = (640, 480)
BOARD = Chessboard((7, 5), 0.03)
EYE = np.eye(4).tolist()
VIEWS = (((20.0, 0.0), 0.0), ((-20.0, 15.0), 40.0), ((5.0, -30.0), -30.0), ((30.0, 20.0), 90.0))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    """Four views of a board, one picture without it, and a file that is no picture."""
    folder: Path = tmp_path_factory.mktemp("set") / "images"
    folder.mkdir()
    for i, (tilt, spin) in enumerate(VIEWS):
        H = homography(BOARD, SIZE, 0.42, tilt, spin, focal=500.0)
        cv2.imwrite(str(folder / f"{i}.png"), picture(BOARD, H, SIZE, seed=i))
    cv2.imwrite(str(folder / "none.png"), np.full((480, 640), 128, np.uint8))
    cv2.imwrite(str(folder / "small.png"), np.full((240, 320), 128, np.uint8))
    (folder / "text.png").write_text("not a picture")
    return folder.parent


def document(
    kind: str = "intrinsic", images=("0", "1", "2", "3"), **changes: Any
) -> dict[str, Any]:
    views = [{"id": name, "image": f"images/{name}.png"} for name in images]
    if kind == "hand-eye":
        views = [{**view, "T_base_flange": EYE} for view in views]
        changes = {"mount": "eye-to-hand", **changes}
    return {
        "format": "cellctl-dataset/1",
        "kind": kind,
        "image_size": list(SIZE),
        "board": BOARD.to_dict(),
        "views": views,
        **changes,
    }


def write(folder: Path, content: Any) -> Path:
    text = content if isinstance(content, str) else json.dumps(content)
    (folder / "dataset.json").write_text(text)
    return folder


def test_a_sound_set_is_solved(pictures):
    result = solve_dataset(write(pictures, document()))
    assert result["kind"] == "intrinsic"
    assert result["views"] == {"used": ["0", "1", "2", "3"], "rejected": []}
    assert result["held_out_px"] < 1.0
    assert result["camera"]["image_size"] == list(SIZE)
    assert result["camera"]["distortion"]["model"] == "plumb_bob"
    assert result["verdict"] == "fail"  # four views are too few to trust
    json.dumps(result)


def test_the_order_of_the_views_does_not_matter(pictures):
    first = solve_dataset(write(pictures, document()))
    backwards = solve_dataset(write(pictures, document(images=("3", "1", "2", "0"))))
    assert json.dumps(first) == json.dumps(backwards)


def test_a_picture_without_the_board_is_rejected_by_id(pictures):
    result = solve_dataset(write(pictures, document(images=("0", "1", "2", "3", "none"))))
    assert result["views"]["rejected"] == [{"id": "none", "reason": NOT_FOUND}]


def test_notes_in_the_file_are_ignored(pictures):
    noted = document(note="taken on Monday")
    noted["views"][0]["light"] = "bright"
    assert load_dataset(write(pictures, noted)).board == BOARD


def far(metres: float) -> list[list[float]]:
    return pose_matrix((0.0, 0.0, 0.0), (metres, 0.0, 0.0)).tolist()


VIEW = {"id": "0", "image": "images/0.png"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not valid JSON"),
        ("[]", "must be a JSON object"),
        ("[" * 100000, "not valid JSON"),
        (document(format="cellctl-dataset/9"), "format must be 'cellctl-dataset/1'"),
        (document(kind="projector"), "unknown kind 'projector'; known: intrinsic, hand-eye"),
        (document(kind="markers"), "'markers' cannot be solved by this version"),
        (document(image_size=[640]), "image_size"),
        (document(image_size=[640.5, 480]), "image_size"),
        (document(board={"type": "chess"}), "board: unknown board type 'chess'"),
        (document(board=[]), "board: "),
        (document(views=[]), "views: "),
        (document(views=[VIEW, VIEW]), "view '0': this id is used more than once"),
        (document(views=[{"id": "a"}]), r"view 'a' .views.0.image.: missing"),
        (document(views=[{"image": "images/0.png"}]), "views.0.id: missing"),
        (document(views=["images/0.png"]), "views.0: "),
        (
            document(views=[{"id": "a", "image": "no.png"}]),
            "view 'a': image 'no.png' does not exist",
        ),
        (document(views=[{"id": "a", "image": "/etc/hosts"}]), "view 'a': .*relative"),
        (document(views=[{"id": "a", "image": "\0"}]), "view 'a': image .* does not exist"),
        (document("hand-eye", mount="on the head"), "mount: "),
        (document("hand-eye", mount=None), "needs mount"),
        (document("hand-eye", views=[VIEW]), "view '0': missing key 'T_base_flange'"),
        (
            document("hand-eye", views=[{**VIEW, "T_base_flange": [[1]]}]),
            r"view '0': T_base_flange must be a 4x4 matrix",
        ),
        (
            document("hand-eye", views=[{**VIEW, "T_base_flange": (2 * np.eye(4)).tolist()}]),
            "view '0': T_base_flange is not rigid",
        ),
        (
            document("hand-eye", views=[{**VIEW, "T_base_flange": far(1e9)}]),
            r"view '0': T_base_flange is 1e\+09 m long; are these millimetres",
        ),
        (
            document("hand-eye", views=[{**VIEW, "T_base_flange": far(800)}]),
            "view '0': T_base_flange is 800 m long; are these millimetres",
        ),
        (
            document("hand-eye", intrinsic_images=["images/9.png"]),
            "view 'images/9.png': image .* does not exist",
        ),
        (document("hand-eye", intrinsic_images=["."]), r"view '\.': image '\.' does not exist"),
        (document("hand-eye", intrinsic_images=["/"]), "view '/': .*relative to the folder"),
        (document("hand-eye", intrinsic_images=[""]), "intrinsic_images"),
        (document(views=[{"id": "a", "image": "../x/0.png"}]), "view 'a': .*within it"),
    ],
)
def test_what_is_wrong_is_named(pictures, content, words):
    with pytest.raises(BadInput, match=f"dataset.json.*{words}"):
        load_dataset(write(pictures, content))


@pytest.mark.parametrize(
    ("image", "words"),
    [("text", "view 'text': text.png is not a picture"), ("small", "320x240, not 640x480")],
)
def test_pictures_that_cannot_be_used_are_named(pictures, image, words):
    with pytest.raises(BadInput, match=words):
        solve_dataset(write(pictures, document(images=("0", image))))


def test_a_folder_without_a_set_says_so(tmp_path):
    with pytest.raises(BadInput, match=r"no dataset\.json here"):
        load_dataset(tmp_path)


def test_a_board_that_is_never_seen_is_named(pictures):
    other = document(board=Chessboard((8, 6), 0.03).to_dict())
    with pytest.raises(BadInput, match=r"the board .*inner_corners \[8, 6\].* is not seen"):
        solve_dataset(write(pictures, other))


def test_the_robot_must_have_turned(pictures):
    """Every view at the same robot pose: no answer, said as every answer is."""
    result = solve_dataset(write(pictures, document("hand-eye", images=("0", "1", "2", "none"))))
    assert (result["kind"], result["verdict"]) == ("hand-eye", "fail")
    assert "two different axes" in result["reasons"][0]
    assert result["views"]["used"] == []
    assert [view["id"] for view in result["views"]["rejected"]] == ["none"]


@pytest.mark.parametrize("kind", ["intrinsic", "hand-eye"])
def test_too_few_views_fail_with_the_reason(pictures, kind):
    result = solve_dataset(write(pictures, document(kind, images=("0", "1", "none"))))
    assert result["verdict"] == "fail"
    assert "2 usable views" in result["reasons"][0]
    assert result["views"]["rejected"] == [{"id": "none", "reason": NOT_FOUND}]


def test_pictures_without_the_board_count_in_the_verdict(pictures):
    blanks = [{"id": f"blank{i}", "image": "images/none.png"} for i in range(3)]
    content = document(images=("0", "1", "2", "3"))
    content["views"] += blanks
    result = solve_dataset(write(pictures, content))
    assert any(r.startswith("3 of 7 views were rejected") for r in result["reasons"])


def turned(name: str, degrees: float) -> dict[str, Any]:
    """A view whose file is that of `name`'s first letter, at a robot pose of its own."""
    pose = pose_matrix(np.radians([degrees, 0.0, 0.0]), (0.0, 0.0, 0.5)).tolist()
    return {"id": name, "image": f"images/{name[0]}.png", "T_base_flange": pose}


def test_the_same_picture_twice_counts_once(pictures):
    content = document()
    content["views"].append({"id": "again", "image": "images/1.png"})
    result = solve_dataset(write(pictures, content))
    assert result["views"] == {
        "used": ["0", "1", "2", "3"],
        "rejected": [{"id": "again", "reason": "the same picture as view '1'"}],
    }


def test_the_same_picture_at_two_robot_poses_counts_not_at_all(pictures):
    """Nothing tells which pose is its own; at the same pose it is a copy, and noise is none."""
    views = [
        turned("0", 0.0),
        turned("1", 20.0),
        turned("1b", 20.01),
        turned("2", 0),
        turned("2b", 9),
    ]
    dataset = load_dataset(write(pictures, document("hand-eye", views=views)))
    seen = observe_with_robot(dataset.board, dataset.images_with_robot())
    assert [view.id for view in seen.views] == ["0", "1"]
    assert {r.id: r.reason for r in seen.unseen} == {
        "1b": "the same picture as view '1'",
        "2": "the same picture as view '2b' but at another robot pose: one of them is mislabelled",
        "2b": "the same picture as view '2' but at another robot pose: one of them is mislabelled",
    }


def test_a_blurred_picture_is_rejected_unless_all_are(pictures):
    def seen(*sigmas: float) -> Observed[View]:
        sharp = [read_picture(pictures / f"images/{i}.png", SIZE, "") for i in range(len(sigmas))]
        soft = [cv2.GaussianBlur(im, (0, 0), s) for im, s in zip(sharp, sigmas, strict=True)]
        return observe(BOARD, [(str(i), np.asarray(image)) for i, image in enumerate(soft)])

    one = seen(0.5, 0.5, 3.0, 0.5)
    assert [view.id for view in one.views] == ["0", "1", "3"]
    assert one.unseen[0].id == "2"
    assert re.match(r"blurred: its edges are \d\.\d px wide", one.unseen[0].reason)
    assert len(seen(2.4, 2.4, 3.0, 2.4).views) == 4


def test_orientation_tags_do_not_turn_pictures(pictures, tmp_path):
    """A phone held upright says so in the file; the sensor is as wide as ever."""
    image = read_picture(pictures / "images/0.png", SIZE, "")
    jpeg = bytes(cv2.imencode(".jpg", image)[1])
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "upright.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    obeyed = cv2.imread(str(tmp_path / "upright.jpg"))
    assert obeyed is not None
    assert obeyed.shape[:2] == (640, 480)
    assert read_picture(tmp_path / "upright.jpg", SIZE, "here").shape == (480, 640)


def test_intrinsic_pictures_may_share_a_name(pictures):
    (pictures / "more").mkdir(exist_ok=True)
    shutil.copy(pictures / "images/1.png", pictures / "more/0.png")
    content = document("hand-eye", intrinsic_images=["images/0.png", "more/0.png"])
    dataset = load_dataset(write(pictures, content))
    assert [picture.id for picture in dataset.intrinsic_pictures] == ["images/0.png", "more/0.png"]


def test_a_tiny_board_is_refused(pictures):
    tiny = {**BOARD.to_dict(), "square_m": 1e-320}
    with pytest.raises(BadInput, match=r"board: square_m .* in metres, from 0\.0001"):
        load_dataset(write(pictures, document(board=tiny)))


def test_intrinsic_pictures_of_another_shape_are_refused(pictures):
    cropped = read_picture(pictures / "images/0.png", SIZE, "")[40:440]
    cv2.imwrite(str(pictures / "images/cropped.png"), cropped)
    mixed = document(
        "hand-eye",
        images=("cropped",),
        image_size=[640, 400],
        intrinsic_images=[f"images/{i}.png" for i in range(4)],
        intrinsic_image_size=list(SIZE),
    )
    with pytest.raises(BadInput, match=r"intrinsic_image_size: camera: .* different shapes"):
        solve_dataset(write(pictures, mixed))


leaves = (
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.just(10**400)
    | st.text(max_size=8)
    | st.sampled_from([".", "/", "..", "../0.png"])
)
anything = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(
    st.sampled_from(["intrinsic", "hand-eye"]),
    st.sampled_from(
        ["image_size", "board", "views", "mount", "intrinsic_images", "kind", "format"]
    ),
    anything,
    st.booleans(),
)
def test_any_value_anywhere_is_read_or_bad_input(pictures, kind, key, value, inside_a_view):
    content = document(kind)
    if inside_a_view:
        content["views"][1] = {**content["views"][1], "T_base_flange": value}
        content["views"][2] = {**content["views"][2], "id": value}
    else:
        content[key] = value
    message = "dataset.json"
    try:
        load_dataset(write(pictures, content))
    except BadInput as error:
        message = error.message
    assert "dataset.json" in message
