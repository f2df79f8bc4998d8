"""Boards as they come out of a renderer: seen by OpenCV, at the right scale, on the page."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2
import hypothesis.strategies as st
import numpy as np
import pypdfium2
import pytest
from hypothesis import given, settings

from cellctl.board_pdf import PAGES, Page, config, parse_page, write_board
from cellctl.calib.targets import ArucoGrid, Board, Charuco, Chessboard, Dots, board_from_dict
from cellctl.errors import BadInput
from cellctl.geometry import Array

DPI = 200
PX_PER_M = DPI / 0.0254

BOARDS: dict[str, Board] = {
    "chessboard": Chessboard((9, 6), 0.03),
    "chessboard, small": Chessboard((7, 10), 0.0123),
    "charuco": Charuco((7, 5), 0.03, 0.022, "DICT_5X5_100", legacy=False),
    "charuco, even rows": Charuco((5, 8), 0.03, 0.02, "DICT_4X4_50", legacy=False),
    "charuco, legacy": Charuco((5, 8), 0.03, 0.02, "DICT_4X4_50", legacy=True),
    "aruco-grid": ArucoGrid((3, 4), 0.05, 0.06, "DICT_4X4_50", first_id=0),
    "aruco-grid, other ids": ArucoGrid((4, 2), 0.04, 0.055, "DICT_6X6_250", first_id=100),
    "dots": Dots((8, 6), 0.025),
}


def render(path: Path, dpi: float = DPI) -> Array:
    """The page as a grey image (h, w)."""
    document = pypdfium2.PdfDocument(path)
    try:
        image = document[0].render(scale=dpi / 72, grayscale=True).to_numpy()
        return np.array(image).reshape(image.shape[:2])
    finally:
        document.close()


def text_of(path: Path) -> str:
    document = pypdfium2.PdfDocument(path)
    try:
        text: str = document[0].get_textpage().get_text_range()
        return text
    finally:
        document.close()


def opencv_board(board: Charuco | ArucoGrid) -> Any:
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    if isinstance(board, ArucoGrid):
        ids = np.arange(board.first_id, board.first_id + board.markers[0] * board.markers[1])
        gap = board.pitch_m - board.marker_m
        return cv2.aruco.GridBoard(board.markers, board.marker_m, gap, family, ids)
    made = cv2.aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, family)
    made.setLegacyPattern(board.legacy)
    return made


def detect(board: Board, image: Array) -> tuple[Array, Array]:
    """Points on the board (n, 2), metres, and where OpenCV sees them (n, 2), px."""
    aruco: Any = cv2.aruco
    match board:
        case Chessboard():
            found, pixels = cv2.findChessboardCornersSB(image, board.inner_corners)
            assert found
            return lattice(board.inner_corners) * board.square_m, upright(pixels)
        case Dots():
            return lattice(board.grid) * board.spacing_m, upright(find_dots(board, image))
        case Charuco():
            made = opencv_board(board)
            corners, ids, _, _ = aruco.CharucoDetector(made).detectBoard(image)
            assert len(ids) == (board.squares[0] - 1) * (board.squares[1] - 1)
            return made.getChessboardCorners()[ids.reshape(-1), :2], corners.reshape(-1, 2)
        case ArucoGrid():
            made = opencv_board(board)
            parameters = aruco.DetectorParameters()
            parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
            detector = aruco.ArucoDetector(made.getDictionary(), parameters)
            corners, ids, _ = detector.detectMarkers(image)
            assert len(ids) == board.markers[0] * board.markers[1]
            points, pixels = made.matchImagePoints(corners, ids)
            return points.reshape(-1, 3)[:, :2], pixels.reshape(-1, 2)
    raise AssertionError(board)


def find_dots(board: Dots, image: Array) -> Array:
    finder: Any = cv2
    blobs = finder.SimpleBlobDetector_Params()
    blobs.maxArea = 1e6
    detector = finder.SimpleBlobDetector_create(blobs)
    found, pixels = finder.findCirclesGrid(image, board.grid, blobDetector=detector)
    assert found
    return np.asarray(pixels)


def lattice(counts: tuple[int, int]) -> Array:
    return np.array([(i, j) for j in range(counts[1]) for i in range(counts[0])], dtype=float)


def upright(found: Any) -> Array:
    """In reading order; the page is not turned, so the first point is top left."""
    pixels = np.asarray(found).reshape(-1, 2)
    return pixels if pixels[0].sum() < pixels[-1].sum() else pixels[::-1]


def check_scale(points: Array, pixels: Array) -> None:
    """x right and y down, without turn or shear, at the renderer's scale to 0.1 %."""
    design = np.column_stack([points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(design, pixels, rcond=None)
    np.testing.assert_allclose(solution[:2], np.eye(2) * PX_PER_M, atol=1e-3 * PX_PER_M)
    assert np.abs(design @ solution - pixels).max() < 0.7


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_opencv_sees_the_board_at_its_scale(board, tmp_path):
    check_scale(*detect(board, render(write_board(board, tmp_path / "board.pdf").path)))


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_calibration_sees_the_board_at_its_scale(board, tmp_path):
    seen = board.detect(render(write_board(board, tmp_path / "board.pdf").path))
    assert len(seen.ids) == len(board.points)
    points = seen.points[:, :2]
    half_a_turn = seen.pixels[0].sum() > seen.pixels[-1].sum()
    if half_a_turn:  # the print does not show it
        assert len(board.symmetries) == 2
        points = points[::-1]
    check_scale(points, seen.pixels)


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_black_and_white_are_where_they_belong(board, tmp_path):
    """OpenCV's own picture of the board, laid over the page; a chessboard by its rule."""
    image = render(write_board(board, tmp_path / "board.pdf").path)
    black = np.argwhere(image[: -round(0.024 * PX_PER_M)] < 128)
    (top, left), (bottom, right) = black.min(axis=0), black.max(axis=0) + 1
    if isinstance(board, Chessboard):
        half = board.square_m * PX_PER_M / 2
        assert image[round(top + half), round(left + half)] == 0
        assert image[round(top + half), round(left + 3 * half)] == 255
    elif isinstance(board, Charuco | ArucoGrid):
        size = (int(right - left), int(bottom - top))
        picture = opencv_board(board).generateImage(size, marginSize=0, borderBits=1)
        page = image[top:bottom, left:right]
        assert np.mean(np.abs(picture.astype(int) - page) > 128) < 0.02


def test_the_ruler_is_as_long_as_it_says(tmp_path):
    sheet = write_board(BOARDS["dots"], tmp_path / "board.pdf")
    dpi = 600
    image = render(sheet.path, dpi)
    row = image[-round(21.5 / 25.4 * dpi)]  # through the ticks of whole centimetres
    ticks = np.flatnonzero(row < 200)
    assert sheet.ruler_mm == 100.0
    assert (ticks[-1] - ticks[0]) / dpi * 25.4 == pytest.approx(100.0, abs=0.1)
    assert "measure this: 100.0 mm" in text_of(sheet.path)
    assert "The board itself: 187.50 x 137.50 mm" in text_of(sheet.path)


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_the_config_line_describes_the_same_board(board, tmp_path):
    line = write_board(board, tmp_path / "board.pdf").config
    assert board_from_dict(tomllib.loads(line)["board"], "test") == board
    assert line in text_of(tmp_path / "board.pdf").replace("\r\n", " ")


def test_the_same_board_is_the_same_file(tmp_path):
    for name in ("one.pdf", "two.pdf"):
        write_board(BOARDS["charuco"], tmp_path / name)
    assert (tmp_path / "one.pdf").read_bytes() == (tmp_path / "two.pdf").read_bytes()


def test_a_board_that_does_not_fit_is_refused_with_the_page_that_does(tmp_path):
    with pytest.raises(BadInput, match=r"A4 is too small\. The smallest that fits: A3"):
        write_board(BOARDS["chessboard"], tmp_path / "b.pdf", parse_page("a4"))
    with pytest.raises(BadInput, match=r"--page 2772x1896"):
        write_board(Chessboard((90, 60), 0.03), tmp_path / "b.pdf")
    assert not (tmp_path / "b.pdf").exists()
    assert write_board(BOARDS["chessboard"], tmp_path / "b.pdf").page == "A3"
    wide = parse_page("2772x1896")
    assert write_board(Chessboard((90, 60), 0.03), tmp_path / "b.pdf", wide).landscape


@pytest.mark.parametrize("text", ["A9", "", "10", "0x0", "-1x5", "100x", "1e3x20"])
def test_pages_that_are_none(text):
    with pytest.raises(BadInput, match="expected A4 to A0"):
        parse_page(text)


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(BadInput, match="No such file or directory"):
        write_board(BOARDS["dots"], tmp_path / "nowhere" / "b.pdf")


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 12), st.integers(3, 12), st.floats(0.004, 0.06))
def test_whatever_is_written_is_whole_on_its_page(tmp_path_factory, columns, rows, square):
    path = tmp_path_factory.mktemp("board") / "b.pdf"
    sheet = write_board(Chessboard((columns, rows), square), path)
    page: Page = next(page for page in PAGES if page.name == sheet.page)
    image = render(path, dpi=25.4)  # a pixel is a millimetre
    assert sorted(image.shape) == pytest.approx([page.short_mm, page.long_mm], abs=1)
    border = np.concatenate([image[:5].ravel(), image[:, :5].ravel(), image[:, -5:].ravel()])
    assert border.min() > 250


def test_toml_of_names_and_flags():
    assert config(BOARDS["charuco, legacy"]).endswith('dictionary = "DICT_4X4_50", legacy = true }')
