"""Calibration boards: how they are printed, and how they are found in a picture.

Board frames are OpenCV's: x right, y down as seen from the front, z into the board. A chessboard
and a dot grid begin at their first inner corner or dot, ChArUco and ArUco grids at the outer
corner of their first square or marker.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from cellctl.calib.aruco import dictionary, find_markers
from cellctl.calib.charuco import CharucoLayout, find_charuco
from cellctl.calib.chessboard import find_chessboard
from cellctl.calib.corners import grey
from cellctl.calib.dots import find_dots
from cellctl.calib.printed import (
    Unseen,
    across_borders,
    check_counts,
    check_ids,
    check_keys,
    check_length,
    lattice,
    neighbours,
    to_dict,
    turns,
)
from cellctl.errors import BadInput
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Detection:
    """`ids` (n,) of the board's points that were seen, their `pixels` (n, 2), and where they are
    on the board, `points` (n, 3) metres. `profiles` (m, 2, 2) are segments on the board, metres,
    each across one printed edge: along them a picture shows how sharp it is."""

    ids: Array
    pixels: Array
    points: Array
    profiles: Array


class Board(Protocol):
    """What is known of a printed board. All are frozen dataclasses and compare by value."""

    minimum_points: ClassVar[int]

    def look(self, image: Any) -> Detection | Unseen:
        """The board in a grey or BGR uint8 picture, or why it is not seen there."""
        ...

    def detect(self, image: Any) -> Detection | None:
        """As `look`, None when it is not seen."""
        ...

    def extent(self) -> tuple[Array, Array]:
        """Smallest and largest coordinates (2,) of the printed area, board metres."""
        ...

    @property
    def points(self) -> Array:
        """All points that can be detected (n, 3), board metres, in the order of their ids."""
        ...

    @property
    def symmetries(self) -> Array:
        """Turns (s, 4, 4) of the board onto itself that its print does not show; the identity
        comes first."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """As written in a data set or a cell's config."""
        ...


class _Printed(ABC):
    """What all boards do alike."""

    @abstractmethod
    def look(self, image: Any) -> Detection | Unseen: ...

    def detect(self, image: Any) -> Detection | None:
        found = self.look(image)
        return found if isinstance(found, Detection) else None

    def to_dict(self) -> dict[str, Any]:
        return to_dict(self)


@dataclass(frozen=True)
class Chessboard(_Printed):
    """`inner_corners` along x and y. The square outside the first inner corner, towards -x and
    -y, is dark: that fixes the orientation of boards with one odd and one even count."""

    inner_corners: tuple[int, int]
    square_m: float
    minimum_points: ClassVar[int] = 6

    def __post_init__(self) -> None:
        check_counts(self, "inner_corners", 3)
        check_length(self, "square_m")

    @property
    def half_turn_ambiguous(self) -> bool:
        """Whether half a turn leaves the print as it was, colours included."""
        return sum(self.inner_corners) % 2 == 0

    @property
    def symmetries(self) -> Array:
        quarters = self.inner_corners[0] == self.inner_corners[1] and not self.inner_corners[0] % 2
        return turns(self.points, 4 if quarters else 2 if self.half_turn_ambiguous else 1)

    @cached_property
    def points(self) -> Array:
        """All inner corners (n, 3), row by row."""
        return lattice(self.inner_corners, self.square_m)

    @cached_property
    def profiles(self) -> Array:
        """From the middle of each inner square to those of its neighbours."""
        return neighbours(self.points[:, :2], self.inner_corners, inner=True)

    def extent(self) -> tuple[Array, Array]:
        return np.full(2, -self.square_m), np.array(self.inner_corners) * self.square_m

    def look(self, image: Any) -> Detection | Unseen:
        pixels = find_chessboard(grey(image), self.inner_corners)
        if isinstance(pixels, Unseen):
            return pixels
        return Detection(np.arange(len(pixels)), pixels, self.points, self.profiles)


@dataclass(frozen=True)
class Charuco(_Printed):
    """A chessboard of `squares` along x and y with ArUco markers in its white squares.
    `legacy` is the pattern of OpenCV before 4.6, which differs for even numbers of rows."""

    squares: tuple[int, int]
    square_m: float
    marker_m: float
    dictionary: str
    legacy: bool = False
    minimum_points: ClassVar[int] = 6

    def __post_init__(self) -> None:
        check_counts(self, "squares", 3)
        check_length(self, "square_m")
        check_length(self, "marker_m")
        if self.marker_m >= self.square_m:
            raise BadInput("marker_m must be smaller than square_m")
        if not isinstance(self.legacy, bool):
            raise BadInput(f"legacy must be true or false, not {self.legacy!r}")
        check_ids(self.dictionary, 0, self.squares[0] * self.squares[1] // 2)

    @property
    def symmetries(self) -> Array:
        return np.eye(4)[None]

    @property
    def points(self) -> Array:
        """All crossings (n, 3), row by row."""
        return np.column_stack([self.layout.corners, np.zeros(len(self.layout.corners))])

    @cached_property
    def layout(self) -> CharucoLayout:
        """Where crossings and markers are."""
        return CharucoLayout.of(
            self.squares, self.square_m, self.marker_m, self.dictionary, legacy=self.legacy
        )

    @cached_property
    def profiles(self) -> Array:
        """Across the black borders of the markers."""
        return across_borders(np.stack(list(self.layout.markers.values())), self.layout.modules)

    def extent(self) -> tuple[Array, Array]:
        return np.zeros(2), np.array(self.squares) * self.square_m

    def look(self, image: Any) -> Detection | Unseen:
        found = find_charuco(grey(image), self.layout)
        if isinstance(found, Unseen):
            return found
        numbers, pixels = found
        return Detection(numbers, pixels, self.points[numbers], self.profiles)


@dataclass(frozen=True)
class ArucoGrid(_Printed):
    """`markers` along x and y, numbered row by row from `first_id`; `pitch_m` from one marker's
    corner to the next one's. Its points are the markers' corners, four a marker, clockwise."""

    markers: tuple[int, int]
    marker_m: float
    pitch_m: float
    dictionary: str
    first_id: int = 0
    minimum_points: ClassVar[int] = 8

    def __post_init__(self) -> None:
        check_counts(self, "markers", 1)
        check_length(self, "marker_m")
        check_length(self, "pitch_m")
        if self.marker_m >= self.pitch_m:
            raise BadInput("marker_m must be smaller than pitch_m, the markers need a white margin")
        if isinstance(self.first_id, bool) or not isinstance(self.first_id, int):
            raise BadInput(f"first_id must be a whole number, not {self.first_id!r}")
        check_ids(self.dictionary, self.first_id, self.markers[0] * self.markers[1])

    @property
    def symmetries(self) -> Array:
        return np.eye(4)[None]

    @cached_property
    def points(self) -> Array:
        """All corners (4 n, 3): those of the first marker, then of the next."""
        corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * self.marker_m
        return (lattice(self.markers, self.pitch_m)[:, None] + corner).reshape(-1, 3)

    @cached_property
    def profiles(self) -> Array:
        """Across the black borders of the markers."""
        modules = dictionary(self.dictionary).markerSize + 2
        return across_borders(self.points[:, :2].reshape(-1, 4, 2), modules)

    def extent(self) -> tuple[Array, Array]:
        return np.zeros(2), (np.array(self.markers) - 1) * self.pitch_m + self.marker_m

    def look(self, image: Any) -> Detection | Unseen:
        found = find_markers(grey(image), self.dictionary)
        numbers = found.ids - self.first_id
        own = (numbers >= 0) & (numbers < self.markers[0] * self.markers[1])
        if not own.any():
            return Unseen()
        ids = (4 * numbers[own][:, None] + np.arange(4)).reshape(-1)
        return Detection(ids, found.corners[own].reshape(-1, 2), self.points[ids], self.profiles)


@dataclass(frozen=True)
class Dots(_Printed):
    """A regular `grid` of dark dots along x and y, `spacing_m` from centre to centre.

    Perspective moves a dot's centre of gravity off its centre; that is corrected, lens
    distortion within a dot is not.
    """

    grid: tuple[int, int]
    spacing_m: float
    minimum_points: ClassVar[int] = 6

    def __post_init__(self) -> None:
        check_counts(self, "grid", 3)
        check_length(self, "spacing_m")

    @property
    def symmetries(self) -> Array:
        return turns(self.points, 4 if self.grid[0] == self.grid[1] else 2)

    @cached_property
    def points(self) -> Array:
        """All centres (n, 3), row by row."""
        return lattice(self.grid, self.spacing_m)

    @cached_property
    def profiles(self) -> Array:
        """From the middle of each dot half-way to its neighbours."""
        ends = neighbours(self.points[:, :2], self.grid)
        return np.stack([ends[:, 0], ends.mean(axis=1)], axis=1)

    def extent(self) -> tuple[Array, Array]:
        half = self.spacing_m / 2
        return np.full(2, -half), np.array(self.grid) * self.spacing_m - half

    def look(self, image: Any) -> Detection | Unseen:
        pixels = find_dots(grey(image), self.grid)
        if isinstance(pixels, Unseen):
            return pixels
        return Detection(np.arange(len(pixels)), pixels, self.points, self.profiles)


TYPES: dict[str, Any] = {
    "chessboard": Chessboard,
    "charuco": Charuco,
    "aruco-grid": ArucoGrid,
    "dots": Dots,
}


def board_from_dict(value: Any, where: str) -> Board:
    """A board as written in a data set or a cell's config. BadInput says `where`, which key, and
    what is wrong with it."""
    if not isinstance(value, dict) or not isinstance(value.get("type"), str):
        raise BadInput(f"{where}: a board needs a type, one of {', '.join(TYPES)}")
    kind = TYPES.get(value["type"])
    if kind is None:
        raise BadInput(f"{where}: unknown board type {value['type']!r}; known: {', '.join(TYPES)}")
    given = {key: item for key, item in value.items() if key != "type"}
    check_keys(kind, given, where)
    try:
        return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})
    except BadInput as error:
        raise BadInput(f"{where}: {error.message}") from None
