"""Data sets: what is read, and every way in which a person may get one wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cellctl.calib.targets import Chessboard
from cellctl.dataset import load_dataset
from cellctl.errors import BadInput, CellctlError
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
    assert result["views"]["rejected"] == [
        {"id": "none", "reason": "the board was not found in the picture"}
    ]


def test_notes_in_the_file_are_ignored(pictures):
    noted = document(note="taken on Monday")
    noted["views"][0]["light"] = "bright"
    assert load_dataset(write(pictures, noted)).board == BOARD


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
        (document(kind="projector-graycode"), "'projector-graycode' cannot be solved"),
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
            document("hand-eye", intrinsic_images=["images/9.png"]),
            "view '9': image .* does not exist",
        ),
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
    """Every view at the same robot pose: no answer, and the reason in words."""
    with pytest.raises(CellctlError, match="two different axes"):
        solve_dataset(write(pictures, document("hand-eye")))


def test_intrinsic_pictures_of_another_shape_are_refused(pictures):
    mixed = document(
        "hand-eye",
        images=("small",),
        image_size=[320, 200],
        intrinsic_images=[f"images/{i}.png" for i in range(4)],
        intrinsic_image_size=list(SIZE),
    )
    with pytest.raises(BadInput, match=r"intrinsic_image_size: camera: .* different shapes"):
        solve_dataset(write(pictures, mixed))


leaves = st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8)
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
        content["views"][1] = {**content["views"][1], "T_base_flange": value, "id": value}
    else:
        content[key] = value
    message = "dataset.json"
    try:
        load_dataset(write(pictures, content))
    except BadInput as error:
        message = error.message
    assert "dataset.json" in message
