"""Boards found in rendered pictures: where, in which orientation, and when they are not there."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cellctl.calib.aruco import find_markers
from cellctl.calib.beyond import print_goes_on
from cellctl.calib.corners import refine_crossings
from cellctl.calib.printed import NOT_FOUND, Unseen
from cellctl.calib.sharpness import TOO_BLURRED_PX, sharpness
from cellctl.calib.targets import ArucoGrid, Board, Charuco, Chessboard, Detection, Dots
from cellctl.dataset import load_dataset
from cellctl.errors import BadInput
from cellctl.geometry import Array, transform_points
from tests.calib.render import homography, picture, truth

SIZE = (1280, 720)
CHESS = Chessboard((9, 6), 0.03)
CHARUCO = Charuco((7, 5), 0.03, 0.021, "DICT_4X4_50")
LEGACY = Charuco((6, 8), 0.025, 0.018, "DICT_5X5_100", legacy=True)
GRID = ArucoGrid((3, 4), 0.05, 0.06, "DICT_4X4_50")
DOTS = Dots((9, 7), 0.03)


def shot(
    board: Board,
    spin: float,
    distance: float = 0.55,
    tilt: tuple[float, float] = (25.0, -20.0),
    blur: float = 0.7,
) -> tuple[Any, Array]:
    H = homography(board, SIZE, distance, tilt, spin)
    return picture(board, H, SIZE, seed=int(spin), blur=blur), H


@pytest.mark.parametrize(
    ("board", "noise_px"),
    [(CHESS, 0.03), (CHARUCO, 0.05), (LEGACY, 0.06), (GRID, 0.05), (DOTS, 0.04)],
)
def test_corners_are_where_they_are(board, noise_px):
    """Noise per axis, and no bias, over views at several turns; every point of the board."""
    errors = []
    for spin in (0.0, 77.0, 200.0):
        image, H = shot(board, spin)
        found = board.detect(image)
        assert found is not None
        assert len(found.ids) == len(board.points)
        candidates = [
            found.pixels - truth(transform_points(turn, board.points), H)[found.ids]
            for turn in board.symmetries
        ]
        errors.append(min(candidates, key=lambda e: float(np.square(e).sum())))
        assert np.array_equal(found.points, board.points[found.ids])
    off = np.concatenate(errors)
    assert off.std() < noise_px
    assert np.abs(off.mean(axis=0)).max() < max(0.01, 4 * noise_px / np.sqrt(len(off)))


def test_refinement_beats_opencvs():
    """Windows that follow the board may be larger without meeting the neighbours' edges."""
    image, H = shot(CHESS, 33.0)
    expected = truth(CHESS.points, H)
    found = CHESS.detect(image)
    assert found is not None
    start = (expected + 0.3).astype(np.float32).reshape(-1, 1, 2)
    theirs = cv2.cornerSubPix(image, start, (7, 7), (-1, -1), (3, 50, 1e-3)).reshape(-1, 2)
    assert (found.pixels - expected).std() < 0.9 * (theirs - expected).std()


def test_marker_corners_beat_opencvs():
    image, H = shot(GRID, 33.0)
    expected = truth(GRID.points, H).reshape(-1, 4, 2)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters
    )
    corners, ids, _ = detector.detectMarkers(image)
    theirs = np.array(corners).reshape(-1, 4, 2) - expected[np.ravel(ids)]
    ours = find_markers(image, "DICT_4X4_50")
    assert (ours.corners - expected[ours.ids]).std() < 0.4 * theirs.std()
    centres = ours.centres() - truth(GRID.points.reshape(-1, 4, 3).mean(axis=1), H)[ours.ids]
    assert centres.std() < 0.035


def test_a_small_marker_does_not_spoil_the_others():
    """One that belongs to something else, in a corner of the picture."""
    image, _ = shot(GRID, 33.0)
    alone = find_markers(image, "DICT_4X4_50")
    image[10:60, 10:60] = 255
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[25:43, 25:43] = cv2.aruco.generateImageMarker(family, 40, 18)
    both = find_markers(image, "DICT_4X4_50")
    assert both.ids.tolist() == [*alone.ids.tolist(), 40]
    assert np.abs(both.corners[:-1] - alone.corners).max() < 1e-9


@pytest.mark.parametrize("spin", [0.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("board", [CHESS, Chessboard((6, 9), 0.03)])
def test_colours_tell_the_ends_of_a_chessboard_apart(board, spin):
    """The same physical corner comes first, however the board is turned."""
    image, H = shot(board, spin, tilt=(10.0, 5.0))
    found = board.detect(image)
    assert found is not None
    assert np.abs(found.pixels - truth(board.points, H)).max() < 0.3


def test_a_square_odd_board_is_turned_by_its_colours():
    board = Chessboard((7, 7), 0.03)
    for spin in (0.0, 90.0):
        image, H = shot(board, spin, tilt=(10.0, 5.0))
        found = board.detect(image)
        assert found is not None
        options = [truth(transform_points(turn, board.points), H) for turn in board.symmetries]
        assert min(np.abs(found.pixels - option).max() for option in options) < 0.3


@pytest.mark.parametrize("board", [CHESS, CHARUCO, GRID, DOTS])
def test_nothing_is_found_where_nothing_is(board):
    rng = np.random.default_rng(0)
    noise = rng.normal(140, 2, (1080, 1920)).clip(0, 255).astype(np.uint8)
    blocks = cv2.resize(
        rng.integers(0, 255, (30, 50), dtype=np.uint8),
        (1920, 1080),
        interpolation=cv2.INTER_NEAREST,
    )
    for image in (noise, np.zeros_like(noise), blocks):
        start = time.process_time()
        assert board.detect(image) is None
        assert time.process_time() - start < 1.0  # OpenCV alone takes up to a minute on noise


def test_a_board_that_is_cut_off_is_not_found():
    image, _ = shot(CHESS, 0.0)
    cut = image.copy()
    cut[:, :560] = 120
    assert CHESS.detect(cut) is None


def test_a_smaller_board_is_not_taken_for_ours():
    image, _ = shot(Chessboard((8, 5), 0.03), 0.0)
    assert CHESS.detect(image) is None


@pytest.mark.parametrize("spin", [0.0, 90.0, 160.0])
@pytest.mark.parametrize(
    ("printed", "stated", "words"),
    [
        (CHESS, Chessboard((8, 6), 0.03), "goes on beyond 8x6 inner corners"),
        (CHESS, Chessboard((9, 5), 0.03), "goes on beyond 9x5 inner corners"),
        (DOTS, Dots((9, 6), 0.03), "goes on beyond 9x6 dots"),
        (DOTS, Dots((8, 7), 0.03), "goes on beyond 8x7 dots"),
    ],
)
def test_part_of_a_larger_board_is_not_taken_for_ours(printed, stated, words, spin):
    """As far as OpenCV finds such a part at all; whatever it finds is refused."""
    image, _ = shot(printed, spin)
    found = stated.look(image)
    assert isinstance(found, Unseen)
    assert words in found.reason or found.reason == NOT_FOUND


@pytest.mark.parametrize(("board", "alternating"), [(CHESS, True), (DOTS, False)])
def test_the_print_ends_where_it_ends(board, alternating):
    """Any part of a board goes on, the whole one does not, however tilted."""
    for tilt in ((0.0, 0.0), (40.0, -30.0)):
        image, H = shot(board, 20.0, tilt=tilt)
        columns, rows = board.inner_corners if alternating else board.grid
        grid = truth(board.points, H).reshape(rows, columns, 2)
        assert not print_goes_on(image, grid, alternating=alternating)
        for part in (grid[1:], grid[:-1], grid[:, 1:], grid[:, :-1], grid[1:-1, 1:-1]):
            assert print_goes_on(image, part, alternating=alternating)


@pytest.mark.parametrize("squares", [(6, 8), (9, 6)])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_other_pattern_of_charuco_boards_is_named(squares, legacy):
    """With the wrong one most crossings look right, one square off."""
    board = Charuco(squares, 0.025, 0.018, "DICT_5X5_100", legacy=legacy)
    image, _ = shot(board, 30.0)
    assert isinstance(board.look(image), Detection)
    found = replace(board, legacy=not legacy).look(image)
    assert isinstance(found, Unseen)
    assert "legacy is stated wrong" in found.reason


def test_a_charuco_board_of_other_squares_is_named():
    image, _ = shot(CHARUCO, 30.0)
    found = replace(CHARUCO, squares=(8, 5)).look(image)
    assert isinstance(found, Unseen)
    assert "markers are not where the board should have them" in found.reason


def test_single_false_markers_do_not_spoil_a_board():
    """Another board's marker in the picture, with a number that ours has: covered there, seen
    elsewhere."""
    image, H = shot(CHARUCO, 0.0, tilt=(0.0, 0.0))
    place = truth(np.column_stack([CHARUCO.layout.markers[3], np.zeros(4)]), H)
    low, high = place.min(axis=0).astype(int) - 2, place.max(axis=0).astype(int) + 3
    image[low[1] : high[1], low[0] : high[0]] = 210
    image[20:100, 20:100] = 255
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[30:90, 30:90] = cv2.aruco.generateImageMarker(family, 3, 60)
    found = CHARUCO.detect(image)
    assert found is not None
    assert len(found.ids) == len(CHARUCO.points)
    assert np.abs(found.pixels - truth(found.points, H)).max() < 0.3


def test_real_boards_that_are_mislabelled(shared_data: Path):
    """A chessboard stated one column short, a ChArUco board with the other pattern: no picture."""
    left = load_dataset(shared_data / "opencv_left_intr")
    arm = load_dataset(shared_data / "ur_charuco_eih")
    assert isinstance(left.board, Chessboard)
    assert isinstance(arm.board, Charuco)
    short = replace(left.board, inner_corners=(8, 6))
    assert all(short.detect(image) is None for _, image in left.images())
    other = replace(arm.board, legacy=not arm.board.legacy)
    assert all(other.detect(image) is None for _, image in arm.images())


def test_hidden_crossings_are_not_invented():
    image, H = shot(CHARUCO, 10.0)
    expected = truth(CHARUCO.points, H)
    low, high = expected[:9].min(axis=0).astype(int), expected[:9].max(axis=0).astype(int)
    image[low[1] - 15 : high[1] + 15, low[0] - 15 : high[0] + 15] = 90
    hidden = ((expected > low - 15) & (expected < high + 15)).all(axis=1)
    found = CHARUCO.detect(image)
    assert found is not None
    assert not hidden[found.ids].any()
    assert len(found.ids) >= 0.7 * np.count_nonzero(~hidden)
    assert np.abs(found.pixels - expected[found.ids]).max() < 0.3


def test_colour_pictures_are_as_good_as_grey_ones():
    image, _ = shot(GRID, 0.0)
    grey, colour = GRID.detect(image), GRID.detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    assert grey is not None
    assert colour is not None
    assert np.allclose(grey.pixels, colour.pixels)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((100, 100)), "uint8"),
        (np.zeros((100, 100, 4), np.uint8), "grey or .* BGR"),
        (np.zeros((4, 100), np.uint8), "too small"),
        (None, "NoneType"),
        ([[0]], "list"),
    ],
)
@pytest.mark.parametrize("board", [CHESS, CHARUCO, GRID, DOTS])
def test_other_arrays_are_refused(board, image, words):
    with pytest.raises(BadInput, match=words):
        board.detect(image)


@pytest.mark.parametrize("board", [CHESS, CHARUCO, GRID, DOTS])
def test_sharpness_tells_blurred_from_sharp(board):
    widths = []
    for blur in (0.6, 2.0):
        image, _ = shot(board, 15.0, distance=0.4, blur=blur)
        found = board.detect(image)
        assert found is not None
        widths.append(sharpness(image, found))
    assert widths[0] < 2.6 < TOO_BLURRED_PX < widths[1]


def test_sharpness_is_opencvs():
    image, _ = shot(CHESS, 0.0, tilt=(0.0, 0.0), blur=1.0)
    found = CHESS.detect(image)
    assert found is not None
    corners = found.pixels.astype(np.float32).reshape(-1, 1, 2)
    theirs, _ = cv2.estimateChessboardSharpness(image, (9, 6), corners)
    assert sharpness(image, found) == pytest.approx(np.ravel(theirs)[0], rel=0.15)


def test_a_crossing_needs_two_directions():
    """An edge alone does not move a corner anywhere."""
    image = np.full((60, 60), 30, np.uint8)
    image[:, 30:] = 220
    start = np.array([[29.5, 30.0]])
    axes = np.array([[[8.0, 0.0], [0.0, 8.0]]])
    assert np.abs(refine_crossings(image, start, axes) - start).max() < 1e-6


def photo(folder: Path, name: str) -> Any:
    image = cv2.imread(str(folder / "aruco_grid_photos" / "images" / name), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def test_photos(shared_data: Path):
    """Phone and webcam photos, counts as their makers state them."""
    grid = find_markers(photo(shared_data, "grid20x20.jpg"), "DICT_6X6_1000", precise=False)
    assert grid.ids.tolist() == list(range(400))
    singles = find_markers(photo(shared_data, "singles.jpg"), "DICT_6X6_250", precise=False)
    assert {23, 40, 62, 98, 124, 203} <= set(singles.ids.tolist())


def test_photos_of_charuco_boards(shared_data: Path):
    """One of the two is partly covered: 16 crossings are in sight."""
    board = Charuco((5, 7), 0.04, 0.02, "DICT_6X6_250")
    whole = board.detect(photo(shared_data, "charuco5x7.jpg"))
    assert whole is not None
    assert len(whole.ids) == 24
    covered = board.detect(photo(shared_data, "charuco5x7_occluded.jpg"))
    assert covered is not None
    assert 15 <= len(covered.ids) <= 18
