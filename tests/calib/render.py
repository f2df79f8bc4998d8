"""Pictures of boards: a texture seen through a homography, blurred and noisy. No lens, no light.

Pixel centres are at integers, in textures as in pictures.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cellctl.calib.aruco import dictionary
from cellctl.calib.targets import ArucoGrid, Board, Charuco, Chessboard, Dots
from cellctl.geometry import Array

TEXTURE_PX_PER_M = 8000.0
BORDER_M = 0.02
SUPERSAMPLE = 4
DARK, BRIGHT, BACKGROUND = 30.0, 210.0, 120.0


def texture(board: Board) -> tuple[Array, Array]:
    """A picture of the print with a white border, and the map (3, 3) from board metres to it."""
    low, high = board.extent()
    low, high = low - BORDER_M, high + BORDER_M
    width, height = np.round((high - low) * TEXTURE_PX_PER_M).astype(int)
    image = np.full((height, width), 255, np.uint8)
    to_px = np.array(
        [
            [TEXTURE_PX_PER_M, 0.0, -low[0] * TEXTURE_PX_PER_M - 0.5],
            [0.0, TEXTURE_PX_PER_M, -low[1] * TEXTURE_PX_PER_M - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    PAINTERS[type(board)](board, image, -low)
    return image, to_px


def _box(image: Array, x: float, y: float, side: float) -> None:
    """Blacken [x, x + side) x [y, y + side), metres from the texture's corner."""
    k = TEXTURE_PX_PER_M
    image[round(y * k) : round((y + side) * k), round(x * k) : round((x + side) * k)] = 0


def _paint_chessboard(board: Chessboard, image: Array, origin: Array) -> None:
    columns, rows = board.inner_corners
    s = board.square_m
    for row in range(-1, rows):
        for column in range(-1, columns):
            if (row + column) % 2 == 0:
                _box(image, origin[0] + column * s, origin[1] + row * s, s)


def _paint_markers(image: Array, origin: Array, name: str, corners: list[Any], side: float) -> None:
    k = TEXTURE_PX_PER_M
    for number, (x, y) in corners:
        px = round(side * k)
        marker = cv2.aruco.generateImageMarker(dictionary(name), number, px)
        row, column = round((origin[1] + y) * k), round((origin[0] + x) * k)
        image[row : row + px, column : column + px] = marker


def _paint_charuco(board: Charuco, image: Array, origin: Array) -> None:
    s = board.square_m
    cv = cv2.aruco.CharucoBoard(board.squares, s, board.marker_m, dictionary(board.dictionary))
    cv.setLegacyPattern(board.legacy)
    first_white = board.legacy and board.squares[1] % 2 == 0
    for row in range(board.squares[1]):
        for column in range(board.squares[0]):
            if (row + column) % 2 == int(first_white):
                _box(image, origin[0] + column * s, origin[1] + row * s, s)
    first = np.asarray(cv.getObjPoints()).reshape(-1, 4, 3)[:, 0, :2]
    corners = list(zip(np.asarray(cv.getIds()).ravel().tolist(), first, strict=True))
    _paint_markers(image, origin, board.dictionary, corners, board.marker_m)


def _paint_grid(board: ArucoGrid, image: Array, origin: Array) -> None:
    columns, rows = board.markers
    corners = [
        (board.first_id + row * columns + column, (column * board.pitch_m, row * board.pitch_m))
        for row in range(rows)
        for column in range(columns)
    ]
    _paint_markers(image, origin, board.dictionary, corners, board.marker_m)


def _paint_dots(board: Dots, image: Array, origin: Array) -> None:
    columns, rows = board.grid
    k, shift = TEXTURE_PX_PER_M, 8
    for row in range(rows):
        for column in range(columns):
            centre = (origin + np.array([column, row]) * board.spacing_m) * k - 0.5
            fixed = tuple(round(c * 2**shift) for c in centre)
            cv2.circle(
                image, fixed, int(0.25 * board.spacing_m * k * 2**shift), 0, -1, cv2.LINE_AA, shift
            )


PAINTERS: dict[type, Any] = {
    Chessboard: _paint_chessboard,
    Charuco: _paint_charuco,
    ArucoGrid: _paint_grid,
    Dots: _paint_dots,
}


def homography(
    board: Board,
    size: tuple[int, int],
    distance_m: float,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    spin_deg: float = 0.0,
    focal: float = 915.0,
) -> Array:
    """Board metres -> pixels of a pinhole camera that sees the board in its middle."""
    w, h = size
    K = np.array([[focal, 0, (w - 1) / 2], [0, focal, (h - 1) / 2], [0, 0, 1.0]])
    low, high = board.extent()
    R = Rotation.from_euler("zyx", [spin_deg, tilt_deg[1], tilt_deg[0]], degrees=True).as_matrix()
    t = np.array([0.0, 0.0, distance_m]) - R @ np.append((low + high) / 2, 0.0)
    return K @ np.column_stack([R[:, 0], R[:, 1], t])


def picture(
    board: Board,
    H: Array,
    size: tuple[int, int],
    *,
    blur: float = 0.7,
    noise: float = 2.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """uint8 picture (h, w) of the board through H, and nothing else in sight."""
    image, to_px = texture(board)
    s = SUPERSAMPLE
    up = np.array([[s, 0, (s - 1) / 2], [0, s, (s - 1) / 2], [0, 0, 1.0]])
    scaled: Any = DARK + image.astype(np.float32) * ((BRIGHT - DARK) / 255.0)
    M = up @ H @ np.linalg.inv(to_px)
    # the texture is finer than the picture: soften it first, or the samples alias
    ratio = TEXTURE_PX_PER_M / (s * _scale(H, board))
    if ratio > 1:
        scaled = cv2.GaussianBlur(scaled, (0, 0), 0.5 * ratio)
    big = cv2.warpPerspective(
        scaled, M, (size[0] * s, size[1] * s), flags=cv2.INTER_LINEAR, borderValue=BACKGROUND
    )
    small: Any = cv2.resize(big, size, interpolation=cv2.INTER_AREA)
    if blur:
        small = cv2.GaussianBlur(small, (0, 0), blur)
    small = small + np.random.default_rng(seed).normal(0, noise, small.shape)
    return np.clip(np.round(small), 0, 255).astype(np.uint8)


def _scale(H: Array, board: Board) -> float:
    """Picture pixels per board metre, about the middle."""
    low, high = board.extent()
    middle = (low + high) / 2
    ends = np.array([[*middle, 1.0], [middle[0] + 1e-3, middle[1], 1.0]]) @ H.T
    ends = ends[:, :2] / ends[:, 2:]
    return float(np.linalg.norm(ends[1] - ends[0])) * 1e3


def truth(points: Array, H: Array) -> Array:
    """Pixels (n, 2) of board points (n, 3) through H."""
    mapped = np.column_stack([points[:, :2], np.ones(len(points))]) @ H.T
    return mapped[:, :2] / mapped[:, 2:]
