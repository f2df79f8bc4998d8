"""Boards as values: what is written, what is refused, and agreement with OpenCV's objects."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.aruco import dictionary
from cellctl.calib.targets import ArucoGrid, Charuco, Chessboard, Dots, board_from_dict
from cellctl.errors import BadInput
from cellctl.geometry import transform_points

BOARDS = [
    Chessboard((9, 6), 0.03),
    Charuco((5, 7), 0.036, 0.018, "DICT_6X6_250"),
    Charuco((6, 8), 0.03, 0.022, "DICT_5X5_100", legacy=True),
    ArucoGrid((3, 4), 0.05, 0.06, "DICT_4X4_50", 7),
    Dots((9, 7), 0.02),
]


@pytest.mark.parametrize("board", BOARDS)
def test_written_and_read_again(board):
    assert board_from_dict(json.loads(json.dumps(board.to_dict())), "file") == board


@pytest.mark.parametrize("board", BOARDS)
def test_points_lie_in_the_extent(board):
    low, high = board.extent()
    assert (board.points[:, :2] >= low - 1e-12).all()
    assert (board.points[:, :2] <= high + 1e-12).all()


@pytest.mark.parametrize("board", BOARDS)
def test_symmetries_map_the_points_onto_themselves(board):
    for turn in board.symmetries:
        turned = transform_points(turn, board.points)
        gaps = np.linalg.norm(turned[:, None] - board.points[None], axis=-1)
        assert gaps.min(axis=1).max() < 1e-12


@pytest.mark.parametrize(
    ("corners", "turns"), [((9, 6), 1), ((9, 7), 2), ((8, 6), 2), ((7, 7), 2), ((6, 6), 4)]
)
def test_which_turns_a_chessboard_does_not_show(corners, turns):
    board = Chessboard(corners, 0.03)
    assert len(board.symmetries) == turns
    assert board.half_turn_ambiguous == (turns > 1)


@pytest.mark.parametrize("board", [b for b in BOARDS if isinstance(b, Charuco)])
def test_charuco_is_opencvs(board):
    theirs = cv2.aruco.CharucoBoard(
        board.squares, board.square_m, board.marker_m, dictionary(board.dictionary)
    )
    theirs.setLegacyPattern(board.legacy)
    assert np.allclose(board.points, theirs.getChessboardCorners(), atol=1e-7)
    markers = np.array(theirs.getObjPoints()).reshape(-1, 4, 3)
    assert np.allclose(list(board.layout.markers.values()), markers[..., :2], atol=1e-7)
    assert list(board.layout.markers) == np.ravel(theirs.getIds()).tolist()


def test_grid_is_opencvs():
    board = ArucoGrid((3, 4), 0.05, 0.06, "DICT_4X4_50")
    theirs = cv2.aruco.GridBoard((3, 4), 0.05, 0.01, dictionary("DICT_4X4_50"))
    assert np.allclose(board.points, np.array(theirs.getObjPoints()).reshape(-1, 3), atol=1e-7)


CHESS = {"type": "chessboard", "inner_corners": [9, 6], "square_m": 0.03}
GRID = {
    "type": "aruco-grid",
    "markers": [3, 4],
    "marker_m": 0.05,
    "pitch_m": 0.06,
    "dictionary": "DICT_4X4_50",
}


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "needs a type"),
        ({"type": 3}, "needs a type"),
        ({"type": "chess"}, "unknown board type 'chess'; known: chessboard"),
        ({**CHESS, "sqare_m": 1}, "unknown key 'sqare_m'; did you mean 'square_m'"),
        ({"type": "chessboard", "square_m": 0.03}, "missing key 'inner_corners'"),
        ({**CHESS, "inner_corners": [9, 6.0]}, "inner_corners"),
        ({**CHESS, "inner_corners": [9]}, "inner_corners"),
        ({**CHESS, "inner_corners": [9, 1000]}, "inner_corners"),
        ({**CHESS, "square_m": 0}, "square_m"),
        ({**CHESS, "square_m": "3 cm"}, "square_m"),
        ({**CHESS, "square_m": float("nan")}, "square_m"),
        ({**CHESS, "square_m": 30}, "square_m must be a length in metres"),
        ({**GRID, "dictionary": "DICT_4x4_50"}, "did you mean DICT_4X4_50"),
        ({**GRID, "dictionary": ["DICT_4X4_50"]}, "dictionary"),
        ({**GRID, "markers": [10, 10]}, "has 50 markers"),
        ({**GRID, "first_id": -1}, "has 50 markers"),
        ({**GRID, "first_id": 1.5}, "first_id"),
        ({**GRID, "marker_m": 0.07}, "smaller than pitch_m"),
    ],
)
def test_what_is_wrong_is_named(value, words):
    with pytest.raises(BadInput, match=f"cell.toml: board.*{words}"):
        board_from_dict(value, "cell.toml: board")


leaves = st.none() | st.booleans() | st.floats() | st.integers(-5, 300) | st.text(max_size=6)
keys = st.sampled_from(
    ["inner_corners", "square_m", "squares", "marker_m", "dictionary", "legacy", "markers"]
    + ["pitch_m", "first_id", "grid", "spacing_m"]
)
values = leaves | st.lists(leaves, max_size=3) | st.just("DICT_4X4_50")


@given(
    st.sampled_from(["chessboard", "charuco", "aruco-grid", "dots"]), st.dictionaries(keys, values)
)
def test_whatever_is_read_is_a_board_or_bad_input(kind, given_values):
    message = ""
    try:
        board = board_from_dict({"type": kind, **given_values}, "file")
        assert len(board.points) >= 4
    except BadInput as error:
        message = error.message
    assert not message or message.startswith("file: ")
