"""Calibration boards as PDF at exact scale, drawn as OpenCV's board objects have them.

Everything is vector graphics: each marker is one path, so that no renderer leaves hairlines
between its modules. The page carries a ruler to check the printer with, and the board's
description as a cell's config and a data set have it.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from reportlab.pdfgen.canvas import Canvas

from cellctl.calib.aruco import dictionary
from cellctl.calib.targets import ArucoGrid, Board, Charuco, Chessboard, Dots
from cellctl.errors import BadInput
from cellctl.geometry import Array

POINT_MM = 25.4 / 72
MARGIN_MM = 6.0
"""What most printers cannot print on."""
RULER_LEFT_MM = 8.0
RULER_BOTTOM_MM = 18.0
FOOTER_MM = 24.0
"""Room for the ruler and the text below the board."""
QUIET_MM = 5.0
"""White around the board at least, and at least as much as its kind needs."""
FONT = "Helvetica"
DOT_DIAMETER = 0.5
"""Of the spacing of the dots."""
NO_DOTS = np.empty((0, 3))

Rectangles = Array
"""(n, 4) as x, y, width, height in board metres, y down."""


@dataclass(frozen=True)
class Page:
    """A size of paper, the shorter side first."""

    name: str
    short_mm: float
    long_mm: float

    def fits(self, width_mm: float, height_mm: float) -> bool:
        short, long = sorted((width_mm, height_mm))
        return short <= self.short_mm and long <= self.long_mm


PAGES = (
    Page("A4", 210, 297),
    Page("A3", 297, 420),
    Page("A2", 420, 594),
    Page("A1", 594, 841),
    Page("A0", 841, 1189),
)


@dataclass(frozen=True, eq=False)
class Artwork:
    """What is black, in board metres: `shapes` are painted one by one, `dots` (n, 3) are x, y and
    radius. `quiet_m` of white belongs around `low` to `high`, the outline of the print."""

    shapes: list[Rectangles]
    dots: Array
    low: Array
    high: Array
    quiet_m: float

    @property
    def size_mm(self) -> Array:
        return (self.high - self.low) * 1000


@dataclass(frozen=True)
class Sheet:
    """What was written. `board_mm` is the black print's outline: measure that, too."""

    path: Path
    page: str
    landscape: bool
    board_mm: tuple[float, float]
    ruler_mm: float
    config: str


def parse_page(text: str) -> Page:
    """A4 to A0, or WIDTHxHEIGHT in millimetres."""
    for page in PAGES:
        if text.upper() == page.name:
            return page
    match = re.fullmatch(r"(\d{2,5}(?:\.\d+)?)x(\d{2,5}(?:\.\d+)?)", text)
    if not match:
        raise BadInput(f"page {text!r}: expected A4 to A0, or WIDTHxHEIGHT in millimetres")
    short, long = sorted(map(float, match.groups()))
    return Page(f"{text} mm", short, long)


def write_board(board: Board, path: Path, page: Page | None = None) -> Sheet:
    """Write `board` to the PDF `path`, on the smallest page of A4 to A0 that it fits on.

    Raises BadInput when it does not fit on `page`, naming the smallest one that does, or when
    the file cannot be written.
    """
    artwork = artwork_of(board)
    page, landscape = _choose(artwork, page)
    width, height = (page.long_mm, page.short_mm) if landscape else (page.short_mm, page.long_mm)
    size = (float(artwork.size_mm[0]), float(artwork.size_mm[1]))
    ruler = min(100.0, 10.0 * ((width - 2 * RULER_LEFT_MM) // 10))
    sheet = Sheet(path, page.name, landscape, size, ruler, config(board))
    try:
        canvas = Canvas(str(path), (width / POINT_MM, height / POINT_MM), invariant=1)
        canvas.setTitle(describe(board))
        canvas.setViewerPreference("PrintScaling", "None")
        canvas.scale(1 / POINT_MM, 1 / POINT_MM)  # millimetres from here on, y up
        _draw(canvas, artwork, width, height)
        _draw_ruler(canvas, ruler)
        _draw_text(canvas, _small_print(board, sheet), width - 2 * RULER_LEFT_MM)
        canvas.save()
    except OSError as error:
        raise BadInput(f"{path} cannot be written: {error.strerror}") from None
    return sheet


def describe(board: Board) -> str:
    """The board in words."""
    match board:
        case Chessboard():
            columns, rows = board.inner_corners
            return f"chessboard, {columns} x {rows} inner corners, squares {_mm(board.square_m)}"
        case Charuco():
            columns, rows = board.squares
            return (
                f"ChArUco, {columns} x {rows} squares {_mm(board.square_m)}, markers "
                f"{_mm(board.marker_m)}, {board.dictionary}{', legacy' if board.legacy else ''}"
            )
        case ArucoGrid():
            columns, rows = board.markers
            return (
                f"ArUco grid, {columns} x {rows} markers {_mm(board.marker_m)}, pitch "
                f"{_mm(board.pitch_m)}, {board.dictionary}, ids from {board.first_id}"
            )
        case Dots():
            columns, rows = board.grid
            return f"dots, {columns} x {rows}, spacing {_mm(board.spacing_m)}"
    raise _unknown(board)


def config(board: Board) -> str:
    """The line for a cell's TOML; a data set's JSON has the same keys."""
    items = (f"{key} = {_toml(value)}" for key, value in board.to_dict().items())
    return f"board = {{ {', '.join(items)} }}"


def artwork_of(board: Board) -> Artwork:
    """What is to be printed."""
    match board:
        case Chessboard():
            return _chessboard(board)
        case Charuco():
            return _charuco(board)
        case ArucoGrid():
            return _grid(board)
        case Dots():
            return _dots(board)
    raise _unknown(board)


def _unknown(board: Board) -> BadInput:
    return BadInput(f"a board of the type {type(board).__name__} cannot be printed yet")


def _chessboard(board: Chessboard) -> Artwork:
    """The square left of and above the first inner corner, the origin, is black."""
    columns, rows = (count + 1 for count in board.inner_corners)
    black = [(i - 1, j - 1) for j in range(rows) for i in range(columns) if (i + j) % 2 == 0]
    squares = _squares(np.array(black) * board.square_m, board.square_m)
    low, high = board.extent()
    return Artwork([squares], NO_DOTS, low, high, board.square_m / 2)


def _charuco(board: Charuco) -> Artwork:
    """Markers stand in the white squares."""
    printed = board.layout.markers
    corners = np.stack(list(printed.values()))
    markers = _markers(np.array(list(printed)), corners, board.dictionary)
    white = {tuple(cell) for cell in np.floor(corners.mean(axis=1) / board.square_m).astype(int)}
    columns, rows = board.squares
    black = [(i, j) for j in range(rows) for i in range(columns) if (i, j) not in white]
    squares = _squares(np.array(black) * board.square_m, board.square_m)
    low, high = board.extent()
    return Artwork([squares, *markers], NO_DOTS, low, high, board.square_m / 4)


def _grid(board: ArucoGrid) -> Artwork:
    corners = board.points.reshape(-1, 4, 3)[..., :2]
    markers = _markers(board.first_id + np.arange(len(corners)), corners, board.dictionary)
    low, high = board.extent()
    quiet = max(board.pitch_m - board.marker_m, board.marker_m / 6)
    return Artwork(markers, NO_DOTS, low, high, quiet)


def _dots(board: Dots) -> Artwork:
    centres = board.points[:, :2]
    radius = board.spacing_m * DOT_DIAMETER / 2
    dots = np.column_stack([centres, np.full(len(centres), radius)])
    low, high = centres.min(axis=0) - radius, centres.max(axis=0) + radius
    return Artwork([], dots, low, high, board.spacing_m / 2)


def _markers(ids: Array, corners: Array, family: str) -> list[Rectangles]:
    """The black modules of each marker; `corners` (n, 4, 2), board metres, clockwise."""
    modules = dictionary(family).markerSize + 2
    shapes = []
    for number, (first, second, _, _) in zip(ids, corners, strict=True):
        image = cv2.aruco.generateImageMarker(dictionary(family), int(number), modules)
        shapes.append(_runs(image, first, (second - first)[0] / modules))
    return shapes


def _runs(image: Array, corner: Array, module_m: float) -> Rectangles:
    """One rectangle for each horizontal run of black modules of a marker's `image`."""
    runs = []
    for j, row in enumerate(np.pad(image == 0, ((0, 0), (1, 1))).astype(int)):
        edges = np.flatnonzero(np.diff(row))
        runs += [(start, j, end - start, 1) for start, end in edges.reshape(-1, 2)]
    return np.array(runs) * module_m + np.append(corner, (0.0, 0.0))


def _squares(corners: Array, side: float) -> Rectangles:
    return np.column_stack([corners, np.full((len(corners), 2), side)])


def _choose(artwork: Artwork, page: Page | None) -> tuple[Page, bool]:
    """The page and whether it lies on its longer side."""
    quiet = max(artwork.quiet_m * 1000, QUIET_MM)
    width, height = artwork.size_mm + 2 * (quiet + MARGIN_MM) + (0.0, FOOTER_MM)
    fitting = [known for known in PAGES if known.fits(width, height)]
    if page is None and fitting:
        page = fitting[0]
    elif page is None or not page.fits(width, height):
        smallest = fitting[0].name if fitting else f"--page {np.ceil(width):g}x{np.ceil(height):g}"
        board = "x".join(f"{side:g}" for side in np.round(artwork.size_mm, 1))
        raise BadInput(
            f"a board of {board} mm needs {width:.0f} x {height:.0f} mm with its white border, "
            f"margins and ruler; {page.name if page else 'A0'} is too small. The smallest that "
            f"fits: {smallest}",
            smallest=smallest,
        )
    return page, bool(width > height)


def _draw(canvas: Canvas, artwork: Artwork, width: float, height: float) -> None:
    """The board, centred above the footer."""
    left = (width - artwork.size_mm[0]) / 2 - artwork.low[0] * 1000
    top = (height + FOOTER_MM + artwork.size_mm[1]) / 2 + artwork.low[1] * 1000
    canvas.setFillGray(0)
    for shape in artwork.shapes:
        path = canvas.beginPath()
        for x, y, w, h in shape * 1000:
            path.rect(left + x, top - y - h, w, h)
        canvas.drawPath(path, stroke=0, fill=1)
    for x, y, radius in artwork.dots * 1000:
        canvas.circle(left + x, top - y, radius, stroke=0, fill=1)


def _draw_ruler(canvas: Canvas, length: float) -> None:
    left, bottom = RULER_LEFT_MM, RULER_BOTTOM_MM
    canvas.setLineWidth(0.1)
    canvas.line(left, bottom, left + length, bottom)
    for mm in range(int(length) + 1):
        tick = 4.0 if mm % 10 == 0 else 3.0 if mm % 5 == 0 else 1.8
        canvas.line(left + mm, bottom, left + mm, bottom + tick)


def _small_print(board: Board, sheet: Sheet) -> tuple[str, ...]:
    width, height = sheet.board_mm
    return (
        f"measure this: {sheet.ruler_mm:.1f} mm. The board itself: {width:.2f} x {height:.2f} mm.",
        "If they are not, print at 100 %, without 'fit to page'.",
        describe(board),
        sheet.config,
    )


def _draw_text(canvas: Canvas, lines: tuple[str, ...], room: float) -> None:
    """Below the ruler; smaller where the page is narrow."""
    for number, text in enumerate(lines):
        size = min(2.2, room / canvas.stringWidth(text, FONT, 1))
        canvas.setFont(FONT, size)
        canvas.drawString(RULER_LEFT_MM, RULER_BOTTOM_MM - 3.6 - 2.8 * number, text)


def _mm(metres: float) -> str:
    return f"{round(metres * 1000, 4):g} mm"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)
