"""Scenes for tests of the rendering: boards held anywhere, pictures to project, detectors."""

from __future__ import annotations

import cv2
import numpy as np

from cellctl.geometry import invert, pose_matrix, transform_points
from cellctl.sim.light import Picture
from cellctl.sim.optics import Instant

DARK = ((1.0, None),)
SUBPIX = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)


def frames_with_flange(flange):
    """Link frames of an arm that is far away but for its flange."""
    frames = np.tile(np.eye(4), (7, 1, 1))
    frames[:6, 0, 3] = 50.0
    frames[6] = flange
    return frames


AWAY = frames_with_flange(pose_matrix((0, 0, 0), (50.0, 0, 0)))


def flange_showing(truth, name, distance, tilt, pixel):
    """T_world_flange that holds board `name` with its middle on the ray of `pixel`."""
    board = truth.boards[name]
    turn = pose_matrix(tilt, (0, 0, 0))
    ray = truth.camera.lens.rays(np.array([pixel], dtype=float))[0]
    turn[:3, 3] = ray * distance - turn[:3, :3] @ (*(board.centre * board.scale), 0.0)
    return truth.camera.pose.matrix @ turn @ invert(board.pose.matrix)


def random_flange(truth, name, rng, distance=(0.35, 1.0)):
    """A board somewhere in view, tilted, wholly above the table."""
    board = truth.boards[name]
    width, height = truth.camera.lens.size
    middle = np.array([width, height]) / 2
    corners = board.centre + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * board.half * 1.2
    while True:
        pixel = middle + rng.uniform(-1, 1, 2) * middle * (0.5, 0.5)
        tilt = rng.normal(size=3) * (0.35, 0.35, 1.0)
        flange = flange_showing(truth, name, rng.uniform(*distance), tilt, pixel)
        places = transform_points(flange @ board.pose.matrix, board.surface(corners))
        pixels = truth.camera.project(places)
        inside = (pixels > 10).all() and (pixels < [width - 10, height - 10]).all()
        if inside and places[:, 2].min() > 0.02:
            return flange


def board_pixels(truth, name, flange, points):
    """Where the truth projects printed points (n, 2) of a board."""
    board = truth.boards[name]
    return truth.camera.project(
        transform_points(flange @ board.pose.matrix, board.surface(np.asarray(points)))
    )


def still(frames, light=DARK):
    return (Instant(1.0, frames, light),)


def showing(image):
    return ((1.0, Picture(image)),)


def chessboard_points(preset):
    columns, rows = preset.inner_corners
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return grid.reshape(-1, 2) * preset.square_m


def find_chessboard(picture, preset, expected):
    """Corners (n, 2) in the order of `expected`, or None."""
    # Without the fast check OpenCV searches for minutes where there is no board.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(picture, preset.inner_corners, flags=flags)
    if not found:
        return None
    columns, rows = preset.inner_corners
    side = np.linalg.norm(np.diff(expected.reshape(rows, columns, 2), axis=1), axis=-1).min()
    window = int(np.clip(0.3 * side, 3, 15))
    corners = cv2.cornerSubPix(picture, corners, (window, window), (-1, -1), SUBPIX).reshape(-1, 2)
    flipped = np.linalg.norm(corners[0] - expected[0]) > np.linalg.norm(corners[-1] - expected[0])
    return corners[::-1] if flipped else corners


def find_markers(picture, dictionary=cv2.aruco.DICT_4X4_50):
    """{id: refined corners (4, 2)}."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))
    corners, ids, _ = detector.detectMarkers(picture)
    if ids is None:
        return {}
    markers = {}
    for marker, found in zip(ids.reshape(-1), corners, strict=True):
        quad = found.reshape(-1, 1, 2)
        side = np.linalg.norm(quad[1] - quad[0])
        # Smaller ones stay at the contour finder's whole pixels, larger ones reach other corners.
        window = int(np.clip(0.05 * side, 3, 8))
        refined = cv2.cornerSubPix(picture, quad, (window, window), (-1, -1), SUBPIX)
        markers[int(marker)] = refined.reshape(4, 2)
    return markers


def marker_corners(preset, marker):
    """Printed corners (4, 2) of a marker of the board, metres."""
    row, column = divmod(marker, preset.markers[0])
    corner = np.array([column, row]) * preset.pitch_m
    return corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * preset.marker_m


def projected_markers(size, side=72):
    """An image full of markers and {id: centre in projector pixels}."""
    width, height = size
    image = np.zeros((height, width), dtype=np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    centres = {}
    step = side + 34
    for marker, (y, x) in enumerate(
        (y, x) for y in range(14, height - step, step) for x in range(20, width - step, step + 17)
    ):
        left = x + 7 * (marker % 5)
        image[y - 12 : y + side + 12, left - 12 : left + side + 12] = 255
        image[y : y + side, left : left + side] = dictionary.generateImageMarker(marker, side)
        centres[marker] = (left + (side - 1) / 2, y + (side - 1) / 2)
    return image, centres


def crossing(quad):
    """Where the diagonals of a quad (4, 2) meet: a marker's centre under perspective."""
    a, b, c, d = quad.astype(float)
    along = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)[0]
    return a + along * (c - a)
