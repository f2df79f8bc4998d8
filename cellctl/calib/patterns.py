"""What the projector shows to be found again by the camera: pictures full of ArUco markers.

Pixel centres are at integers: a marker that covers the pixels x0 .. x0 + s - 1 has its centre at
x0 + (s - 1) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cellctl.calib.aruco import dictionary, find_markers
from cellctl.calib.corners import grey
from cellctl.errors import BadInput
from cellctl.geometry import Array

DICTIONARY = "DICT_4X4_250"
MODULES = 6
"""Side of a marker of DICTIONARY: four bits and the black border."""
LAYOUTS = ((1, 1), (2, 2), (3, 3), (4, 4))
"""Into how many sub-grids, across and down, the grid may be split."""


@dataclass(frozen=True, eq=False)
class MarkerPicture:
    """`image` (h, w) uint8 for the projector, and the centres {id: (2,)} in its pixels."""

    image: NDArray[np.uint8]
    centres: dict[int, Array]
    marker_px: int


def marker_pictures(
    size: tuple[int, int],
    columns: int = 20,
    rows: int = 12,
    *,
    pictures: int = 4,
    minimum_px: float = 0.0,
) -> list[MarkerPicture]:
    """`columns` x `rows` markers for a projector of `size` (w, h), in interleaved sub-grids.

    The sides of the markers grow with the number of pictures. As many `pictures` are made as
    asked for, or more where the markers would be smaller than `minimum_px` projector pixels.
    BadInput when there are more markers than ids, or no layout makes them large enough.
    """
    ids = len(dictionary(DICTIONARY).bytesList)
    if columns < 2 or rows < 2 or columns * rows > ids:
        raise BadInput(f"{columns} x {rows} markers: at least 2 x 2, at most {ids} in all")
    for split in LAYOUTS:
        side = _side(size, columns, rows, split)
        if split[0] * split[1] >= pictures and side >= max(minimum_px, MODULES):
            return [
                _picture(size, (columns, rows), split, side, k) for k in range(split[0] * split[1])
            ]
    raise BadInput(
        f"{columns} x {rows} markers do not fit {size[0]}x{size[1]} pixels in {pictures} or more "
        f"pictures with sides of {max(minimum_px, MODULES):.0f} px: ask for fewer markers"
    )


def _side(size: tuple[int, int], columns: int, rows: int, split: tuple[int, int]) -> int:
    """The largest side, a multiple of MODULES, that leaves a module and a half of white around
    each marker. Along an axis: margin 2 (s/2 + 1.5 m), and between neighbours of one picture
    `split` steps of the grid >= s + 1.5 m."""
    module = 0
    while all(
        split[axis] * (size[axis] - 9 * (module + 1)) / (count - 1) >= 7.5 * (module + 1)
        for axis, count in enumerate((columns, rows))
    ):
        module += 1
    return MODULES * module


def _picture(
    size: tuple[int, int], counts: tuple[int, int], split: tuple[int, int], side: int, k: int
) -> MarkerPicture:
    columns, rows = counts
    across, down = _places(size[0], columns, side), _places(size[1], rows, side)
    image = np.full((size[1], size[0]), 255, dtype=np.uint8)
    centres = {}
    for row in range(k // split[0], rows, split[1]):
        for column in range(k % split[0], columns, split[0]):
            x, y, number = across[column], down[row], row * columns + column
            image[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(
                dictionary(DICTIONARY), number, side
            )
            centres[number] = np.array([x, y]) + (side - 1) / 2
    return MarkerPicture(image, centres, side)


def _places(length: int, count: int, side: int) -> list[int]:
    """First pixels of `count` markers spread evenly over `length`, white at both ends."""
    margin = side // 4
    return [round(x) for x in np.linspace(margin, length - side - margin, count)]


def detect_markers(image: Any) -> dict[int, Array]:
    """Centres {id: (2,)} in camera pixels of the projected markers in a grey or BGR picture.

    The centre is where the diagonals cross, wherever the camera stands.
    """
    found = find_markers(grey(image), DICTIONARY)
    return {int(i): centre for i, centre in zip(found.ids, found.centres(), strict=True)}
