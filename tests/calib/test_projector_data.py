"""Data sets of a projector, from their files to a verdict; rendered ones, and real ones."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellctl.calib.graycode import GrayCode
from cellctl.errors import BadInput, SolveError
from cellctl.offline import solve_folder
from cellctl.projector_data import is_one, load, score, solve
from tests.calib.lit import BOARD, CAMERA, POSES, PROJECTOR, T_PROJECTOR_CAMERA, Scene

SIZE = PROJECTOR.image_size
PATTERN = {"column_bits": 8, "row_bits": 7}
CODE = GrayCode.of(SIZE, column_bits=8, row_bits=7)
"""The finest stripes are left out: it is faster, and people do."""


def names(view: int) -> list[str]:
    return [f"images/{view}/{i:02d}.png" for i in range(len(CODE.slides))]


def document(*views: int) -> dict[str, Any]:
    return {
        "format": "cellctl-dataset/1",
        "kind": "projector-graycode",
        "image_size": list(CAMERA.image_size),
        "board": BOARD.to_dict(),
        "projector": {"size": list(SIZE), "pattern": PATTERN},
        "views": [{"id": f"v{i}", "images": names(i)} for i in views],
    }


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("graycode")
    for i, pose in enumerate(POSES):
        (folder / f"images/{i}").mkdir(parents=True)
        images = Scene(pose).pictures(CODE, seed=i)
        for name, image in zip(names(i), images, strict=True):
            cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return folder


def written(pictures: Path, folder: Path, content: Any) -> Path:
    """A data set of its own, with the same pictures."""
    folder.mkdir(exist_ok=True)
    if not (folder / "images").exists():
        (folder / "images").symlink_to(pictures / "images")
    (folder / "dataset.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def solved(pictures, tmp_path_factory) -> dict[str, Any]:
    result = solve_folder(written(pictures, tmp_path_factory.mktemp("a"), document(2, 0, 1)))
    return json.loads(json.dumps(result, allow_nan=False))


def test_solved(solved):
    assert (solved["kind"], solved["verdict"], solved["reasons"]) == (
        "projector-graycode",
        "pass",
        [],
    )
    assert solved["views"] == {"used": ["v0", "v1", "v2"], "rejected": []}
    assert solved["held_out_px"] < 0.2
    K = np.array(solved["projector"]["K"])
    assert solved["projector"]["size"] == list(SIZE)
    assert K[[0, 1, 1], [0, 1, 2]] == pytest.approx(PROJECTOR.vector[[0, 1, 3]], abs=6.0)
    assert K[1, 2] > SIZE[1]
    pose = np.array(solved["T_projector_camera"])
    assert np.abs(pose[:3, :3] - T_PROJECTOR_CAMERA[:3, :3]).max() < 0.02
    assert np.abs(pose[:3, 3] - T_PROJECTOR_CAMERA[:3, 3]).max() < 0.01


def test_scored_on_what_it_never_saw(pictures, solved, tmp_path):
    other = written(pictures, tmp_path / "b", document(3))
    assert score(solved, other) < 0.2
    worse = copy.deepcopy(solved)
    worse["projector"]["K"][0][2] += 3.0
    assert 2.0 < score(worse, other) < 4.0
    with pytest.raises(BadInput, match="the calibration has no projector"):
        score({"camera": solved["camera"]}, other)
    larger = copy.deepcopy(solved)
    larger["projector"]["size"] = [640, 480]
    with pytest.raises(BadInput, match=r"projector\.size is \(320, 240\)"):
        score(larger, other)


def test_bad_captures_are_named(pictures, tmp_path):
    """A picture of nothing, a capture twice, and pictures of another capture: by id."""
    content = document(0, 1, 2, 3)
    content["views"].append({"id": "again", "images": names(1)})
    mixed = [*names(3)[:12], *names(0)[12:]]
    content["views"].append({"id": "mixed", "images": mixed})
    content["views"].append({"id": "shifted", "images": [names(2)[-1], *names(2)[:-1]]})
    result = solve(written(pictures, tmp_path / "c", content))
    assert result["views"]["used"] == ["again", "v0", "v2", "v3"]
    reasons = {r["id"]: r["reason"] for r in result["views"]["rejected"]}
    assert "the same pictures as view 'again'" in reasons["v1"]
    assert reasons.keys() == {"v1", "mixed", "shifted"}
    assert result["held_out_used_px"] < 0.2


@pytest.mark.long
def test_the_order_of_the_pictures_is_another_one(pictures, tmp_path):
    """Than stated: no answer, and why in every view."""
    content = document(0, 1, 2)
    content["projector"]["pattern"] = {**PATTERN, "order": ["rows", "columns", "black", "white"]}
    with pytest.raises(BadInput, match="board"):
        solve(written(pictures, tmp_path / "d", content))
    content["projector"]["pattern"] = {**PATTERN, "first_bit": "lsb"}
    result = solve(written(pictures, tmp_path / "d", content))
    assert result["verdict"] == "fail"
    assert len(result["views"]["rejected"]) == 3
    with pytest.raises(SolveError, match="no capture can be scored"):
        score(
            {
                "camera": CAMERA.to_dict(),
                "projector": {**PROJECTOR.to_dict(), "size": list(SIZE)},
                "T_projector_camera": T_PROJECTOR_CAMERA.tolist(),
            },
            tmp_path / "d",
        )


@pytest.mark.long
def test_a_projector_that_is_said_to_be_smaller(pictures, tmp_path):
    """Of the same number of bits: the code tells."""
    content = document(0, 1, 2)
    content["projector"] = {"size": [260, 160], "pattern": PATTERN}
    result = solve(written(pictures, tmp_path / "g", content))
    assert result["verdict"] == "fail"
    assert all("check projector.size" in r["reason"] for r in result["views"]["rejected"])


def without(content: dict[str, Any], *path: Any) -> dict[str, Any]:
    inner: Any = content
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return content


def changed(content: dict[str, Any], value: Any, *path: Any) -> dict[str, Any]:
    inner: Any = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return content


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (without(document(0, 1), "projector"), ["projector", "missing"]),
        (without(document(0, 1), "projector", "size"), ["projector.size", "missing"]),
        (changed(document(0, 1), [320], "projector", "size"), ["projector.size"]),
        (without(document(0, 1), "projector", "pattern"), ["v0", "32 pictures", "36"]),
        (without(document(0, 1), "views", 1, "images", 3), ["v1", "images", "31 pictures", "32"]),
        (without(document(0, 1), "views", 1, "images"), ["v1", "images", "missing"]),
        (changed(document(0, 1), "images/0/99.png", "views", 0, "images", 4), ["v0", "99.png"]),
        (changed(document(0, 1), "../x.png", "views", 0, "images", 4), ["v0", "within"]),
        (changed(document(0, 1), names(0)[5], "views", 0, "images", 4), ["v0", "05.png", "once"]),
        (changed(document(0, 1), "v0", "views", 1, "id"), ["v0", "more than once"]),
        (changed(document(0, 1), "stripes", "projector", "pattern"), ["pattern", "cannot tell"]),
        (changed(document(0, 1), [640, 480], "image_size"), ["v0", "480x360", "640x480"]),
        (changed(document(0, 1), {"type": "chessboard"}, "board"), ["board", "inner_corners"]),
    ],
)
def test_what_is_wrong_with_a_file_is_named(pictures, tmp_path, content, words):
    with pytest.raises(BadInput) as caught:
        solve(written(pictures, tmp_path / "e", content))
    for word in ["dataset.json", *words]:
        assert word in caught.value.message


def test_a_picture_that_is_none(pictures, tmp_path):
    folder = tmp_path / "f"
    shutil.copytree(pictures / "images/0", folder / "images/0")
    (folder / names(0)[7]).write_bytes(b"not a picture")
    (folder / "dataset.json").write_text(json.dumps(document(0)))
    with pytest.raises(BadInput, match=r"view 'v0'.*07\.png is not a picture"):
        solve(folder)


LEAVES = (
    st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**400)
    | st.text(max_size=8) | st.sampled_from([".", "..", "images", "images/0/00.png"])
)  # fmt: skip
JSON = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)
PLACES = st.sampled_from(
    [
        ("format",), ("kind",), ("image_size",), ("board",), ("projector",), ("projector", "size"),
        ("projector", "pattern"), ("views",), ("views", 0), ("views", 1, "id"),
        ("views", 1, "images"), ("views", 0, "images", 3),
    ]
)  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(PLACES, JSON)
def test_any_value_anywhere_is_read_or_bad_input(pictures, place, value):
    folder = written(pictures, pictures / "fuzz", document(0, 1))
    (folder / "dataset.json").write_text(json.dumps(changed(document(0, 1), value, *place)))
    message = "dataset.json"
    try:
        if is_one(folder):
            load(folder)
    except BadInput as error:
        message = error.message
    assert "dataset.json" in message


def test_real_captures(shared_data, tmp_path):
    """Held out to a quarter of a projector pixel, the principal point below the image; and a
    capture predicted by the two others."""
    source = shared_data / "procam_graycode_a"
    result = solve_folder(source)
    assert (result["verdict"], result["reasons"]) == ("pass", [])
    assert result["held_out_px"] <= 0.25
    assert 800 < result["projector"]["K"][1][2] < 900
    content = json.loads((source / "dataset.json").read_text())
    parts = []
    for name, views in (("two", content["views"][1:]), ("one", content["views"][:1])):
        parts.append(written(source, tmp_path / name, {**content, "views": views}))
    assert score(solve(parts[0]), parts[1]) <= 0.25
