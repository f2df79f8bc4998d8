"""Finding a ChArUco board: markers say roughly where each crossing is, the crossing says exactly.

OpenCV reports a crossing only between two markers that it decoded. Here each crossing is looked
for where the nearest markers predict it, and taken when the picture shows a crossing there; on
pictures with small markers that finds up to six times as many.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cellctl.calib.aruco import dictionary, find_markers
from cellctl.calib.corners import REACH, Grey, refine_crossings, sample
from cellctl.calib.printed import Unseen, lattice
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.geometry import Array, Mask

MINIMUM_MARKERS = 2
NEAREST = 4
"""Markers that predict a crossing: few enough that lens distortion hardly matters."""
OUTLIER = 0.5
"""A marker is false when it lies so many squares from where the others have it."""
ELSEWHERE, CONTRADICTED, CONTRADICTING = 0.8, 0.2, 3
"""A board is not the one stated when more than this part of its markers, and so many at least, lie
so many squares away: more than a lens bends them, less than another board does."""
ALMOST_ALL = 0.9
OTHER_PATTERN = (
    "its markers are where the other pattern for even numbers of rows has them: the board's "
    "legacy is stated wrong; state the other value (true or false)"
)
MOVED = 0.2
"""Refinement may move a crossing by that many squares."""
LEAST_PX = 2.5
LIKENESS, LIKENESS_STEPS = 0.7, 6


@dataclass(frozen=True, eq=False)
class CharucoLayout:
    """`corners` (n, 2) of the crossings and `markers` {id: corners (4, 2)}, both on the board in
    metres; side of a square and of a marker; name of the dictionary; modules of a marker's side.
    `rivals` are the markers where the other value of `legacy` has them.
    `signs` (n,): 1 where the squares above right and below left of a crossing are dark, else -1.
    """

    corners: Array
    signs: Array
    markers: dict[int, Array]
    rivals: dict[int, Array]
    square_m: float
    marker_m: float
    dictionary: str
    modules: int

    @property
    def gap(self) -> float:
        """White margin around a marker, in squares."""
        return (self.square_m - self.marker_m) / 2 / self.square_m

    def reach(self, square_px: float) -> float:
        """Half the window of refinement, in squares.

        Up to the markers beside a crossing; but where so little is left that noise would rule,
        into the markers' first module: so far the print is point-symmetric about the crossing,
        and what is symmetric does not move it.
        """
        gap = self.gap
        if 0.9 * gap * square_px < LEAST_PX:
            gap += 0.75 * self.marker_m / self.modules / self.square_m
        return min(REACH, 0.9 * gap)

    @classmethod
    def of(
        cls,
        squares: tuple[int, int],
        square_m: float,
        marker_m: float,
        dictionary_name: str,
        *,
        legacy: bool,
    ) -> CharucoLayout:
        """As OpenCV prints it: markers row by row in the white squares, the first square black
        (before 4.6, white for even numbers of rows)."""
        columns, rows = squares
        first_white = legacy and rows % 2 == 0
        crossings = lattice((columns - 1, rows - 1), 1.0)[:, :2]
        other_white = not legacy and rows % 2 == 0
        return cls(
            corners=crossings * square_m + square_m,
            signs=np.where((crossings.sum(axis=1) + first_white) % 2, 1.0, -1.0),
            markers=_places(squares, square_m, marker_m, first_white=first_white),
            rivals=_places(squares, square_m, marker_m, first_white=other_white),
            square_m=square_m,
            marker_m=marker_m,
            dictionary=dictionary_name,
            modules=dictionary(dictionary_name).markerSize + 2,
        )


def _places(
    squares: tuple[int, int], square_m: float, marker_m: float, *, first_white: bool
) -> dict[int, Array]:
    """Corners (4, 2) of the markers by number, board metres."""
    columns, rows = squares
    gap = (square_m - marker_m) / 2
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * marker_m + gap
    white = [
        np.array([column, row]) * square_m + corner
        for row in range(rows)
        for column in range(columns)
        if (row + column) % 2 != int(first_white)
    ]
    return dict(enumerate(white))


def find_charuco(image: Grey, layout: CharucoLayout) -> tuple[Array, Array] | Unseen:
    """Numbers (n,) and pixels (n, 2) of the crossings seen, or why there are none."""
    markers = _markers(image, layout)
    if isinstance(markers, Unseen):
        return markers
    places, pixels = markers
    if len(places) < MINIMUM_MARKERS:
        return Unseen()
    square = layout.square_m * float(_scales(places, pixels).min())
    predicted, axes = _predict(layout, places, pixels)
    numbers = np.flatnonzero(_inside(predicted, image, 0.5 * square))
    if not len(numbers):
        return Unseen()
    refined = refine_crossings(image, predicted[numbers], axes[numbers], layout.reach(square))
    moved = np.linalg.norm(refined - predicted[numbers], axis=1)
    around = axes[numbers] * layout.gap
    likeness = _likeness(image, refined, around, layout.signs[numbers])
    seen = (moved < MOVED * square) & (likeness > LIKENESS)
    return (numbers[seen], refined[seen]) if seen.any() else Unseen()


def _markers(image: Grey, layout: CharucoLayout) -> tuple[Array, Array] | Unseen:
    """Board metres and pixels (m, 4, 2) of the markers that agree with each other."""
    found = find_markers(image, layout.dictionary, precise=False)
    known = [k for k, number in enumerate(found.ids) if int(number) in layout.markers]
    if len(known) < MINIMUM_MARKERS:
        return Unseen()
    places = np.array([layout.markers[int(found.ids[k])] for k in known]).reshape(-1, 4, 2)
    pixels = found.corners[known].reshape(-1, 4, 2)
    off = _off(places, pixels, layout.square_m)
    wrong = off > ELSEWHERE
    if wrong.any() and (reason := _contradiction(layout, found.ids[known], pixels, off)):
        return Unseen(reason)
    return places[off < OUTLIER], pixels[off < OUTLIER]


def _contradiction(layout: CharucoLayout, ids: Array, pixels: Array, off: Array) -> str:
    """Why the board is not the one stated, empty when only single markers (m,) are false; `off`
    is how far each is from its place, squares."""
    wrong = off > ELSEWHERE
    rival = np.array([layout.rivals[int(number)] for number in ids])
    share = float(np.mean(_off(rival, pixels, layout.square_m) < OUTLIER))
    if share > max(ALMOST_ALL, float(np.mean(off < OUTLIER))):
        return OTHER_PATTERN
    if np.count_nonzero(wrong) < CONTRADICTING or wrong.mean() <= CONTRADICTED:
        return ""
    names = ", ".join(str(number) for number in ids[wrong][:8])
    return (
        f"{np.count_nonzero(wrong)} of {len(ids)} markers are not where the board should have "
        f"them (numbers {names}): check its squares, its dictionary and legacy"
    )


def _off(places: Array, pixels: Array, square_m: float) -> Array:
    """How many squares (m,) each marker's pixels (m, 4, 2) lie from where the others have its
    place (m, 4, 2) on the board; zero where too few are seen to tell. A square is that of the
    median marker: the smallest one may be false."""
    square = square_m * float(np.median(_scales(places, pixels)))
    if len(places) <= MINIMUM_MARKERS:
        return np.zeros(len(places))
    ends = places.reshape(-1, 2), pixels.reshape(-1, 2)
    H: Any = cv2.findHomography(*ends, cv2.RANSAC, OUTLIER * square)[0]
    if H is None:
        return np.zeros(len(places))
    off = np.linalg.norm(apply_homography(H, places) - pixels, axis=-1)
    return np.asarray(off.max(axis=-1) / square)


def _scales(places: Array, pixels: Array) -> Array:
    """Pixels per metre (m,) of each marker in the direction in which it is smallest."""
    side = np.linalg.norm(places[0, 1] - places[0, 0])
    sides = np.stack([pixels[:, 1] - pixels[:, 0], pixels[:, 3] - pixels[:, 0]], axis=-1)
    return np.asarray(np.linalg.svd(sides, compute_uv=False)[:, -1] / side)


def _predict(layout: CharucoLayout, places: Array, pixels: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of the crossings and sides of a square there (n, 2, 2), each from the
    homography of its nearest markers."""
    corners, square = layout.corners, layout.square_m
    distance = np.linalg.norm(corners[:, None] - places.mean(axis=1), axis=-1)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEAREST]
    source = places[nearest].reshape(len(corners), -1, 2)
    target = pixels[nearest].reshape(len(corners), -1, 2)
    maps = direct_linear_transform(source, target)
    around = corners[:, None] + square * np.array(
        [[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]]
    )
    homogeneous = np.concatenate([around, np.ones_like(around[..., :1])], axis=-1)
    mapped = homogeneous @ np.swapaxes(maps, 1, 2)
    mapped = mapped[..., :2] / mapped[..., 2:]
    axes = np.stack([mapped[:, 1] - mapped[:, 2], mapped[:, 3] - mapped[:, 4]], axis=1)
    return mapped[:, 0], axes


def _inside(pixels: Array, image: Grey, margin: float) -> Mask:
    h, w = image.shape
    low, high = margin, np.array([w, h]) - 1 - margin
    return np.logical_and.reduce((pixels > low) & (pixels < high), axis=1)


def _likeness(image: Grey, pixels: Array, axes: Array, signs: Array) -> Array:
    """How much each of pixels (n, 2) looks like a crossing with its dark squares where `signs`
    (n,) has them: correlation with two dark and two bright quadrants, softened at their borders.

    1 for a clear one, about 0.5 when one quadrant is covered by something of its opposite colour.
    """
    steps = np.linspace(-1.0, 1.0, 2 * LIKENESS_STEPS)
    u, v = (part.reshape(-1) for part in np.meshgrid(steps, steps))
    values = sample(image, pixels[:, None] + np.stack([u, v], axis=-1) @ axes)
    values = values - values.mean(axis=1, keepdims=True)
    pattern = np.sign(u * v) * np.sqrt(np.abs(u * v))
    norms = np.linalg.norm(values, axis=1) * np.linalg.norm(pattern)
    return signs * (values @ pattern) / np.maximum(norms, 1e-9)
