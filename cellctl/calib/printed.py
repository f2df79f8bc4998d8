"""What the boards have in common: regular grids, their symmetries, and checks of what is read."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from cellctl.calib.aruco import dictionary
from cellctl.errors import BadInput
from cellctl.geometry import Array, pose_matrix

TYPE_NAMES = {
    "Chessboard": "chessboard",
    "Charuco": "charuco",
    "ArucoGrid": "aruco-grid",
    "Dots": "dots",
}
LARGEST_COUNT = 100
LEAST_M, LARGEST_M = 1e-4, 10.0
NOT_FOUND = "the board was not found in the picture"


@dataclass(frozen=True)
class Unseen:
    """Why a picture does not show a board, in words."""

    reason: str = NOT_FOUND


def lattice(counts: tuple[int, int], step: float) -> Array:
    """Points (n, 3) of a regular grid, row by row."""
    columns, rows = counts
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    return np.column_stack([places * step, np.zeros(len(places))])


def turns(points: Array, count: int) -> Array:
    """(count, 4, 4): turns of a full circle's parts about the middle of points (n, 3)."""
    middle = points.mean(axis=0)
    found = []
    for k in range(count):
        turn = pose_matrix((0.0, 0.0, 2.0 * np.pi * k / count), (0.0, 0.0, 0.0))
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        found.append(turn)
    return np.stack(found)


def neighbours(points: Array, counts: tuple[int, int], *, inner: bool = False) -> Array:
    """(m, 2, 2): segments between neighbours of a grid of points (n, 2), row by row; with
    `inner`, between the middles of its cells."""
    places = points.reshape(counts[1], counts[0], 2)
    if inner:
        places = (places[:-1, :-1] + places[1:, :-1] + places[:-1, 1:] + places[1:, 1:]) / 4.0
    across = np.stack([places[:, :-1], places[:, 1:]], axis=2)
    down = np.stack([places[:-1], places[1:]], axis=2)
    return np.concatenate([across.reshape(-1, 2, 2), down.reshape(-1, 2, 2)])


def across_borders(markers: Array, modules: int) -> Array:
    """(4 m, 2, 2): segments across the middle of each side of markers (m, 4, 2), from one
    module outside to one inside."""
    middles = (markers + np.roll(markers, -1, axis=1)) / 2.0
    inward = (markers.mean(axis=1, keepdims=True) - middles) * 2.0 / modules
    return np.stack([middles - inward, middles + inward], axis=2).reshape(-1, 2, 2)


def to_dict(board: Any) -> dict[str, Any]:
    """A board as it is written in files."""
    values = {item.name: getattr(board, item.name) for item in fields(board)}
    plain = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
    return {"type": TYPE_NAMES[type(board).__name__], **plain}


def check_keys(kind: Any, given: Mapping[str, Any], where: str) -> None:
    """BadInput on a key that a board of this kind does not have or lacks."""
    known = [item.name for item in fields(kind)]
    for key in given:
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
            raise BadInput(f"{where}: unknown key {key!r}; {hint}")
    for item in fields(kind):
        if item.default is MISSING and item.name not in given:
            raise BadInput(f"{where}: missing key {item.name!r}")


def check_counts(board: Any, key: str, least: int) -> None:
    value = getattr(board, key)
    whole = isinstance(value, tuple) and all(type(count) is int for count in value)
    if not whole or len(value) != 2 or not least <= min(value) <= max(value) <= LARGEST_COUNT:
        raise BadInput(
            f"{key} must be two whole numbers from {least} to {LARGEST_COUNT}, not {value!r}"
        )


def check_length(board: Any, key: str) -> None:
    value = getattr(board, key)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not LEAST_M <= value <= LARGEST_M:
        raise BadInput(
            f"{key} must be a length in metres, from {LEAST_M:g} to {LARGEST_M:g}, not {value!r}"
        )


def check_ids(name: Any, first: int, count: int) -> None:
    """BadInput when a dictionary is unknown or too small for the markers of a board."""
    if not isinstance(name, str):
        raise BadInput(f"dictionary must be a name such as DICT_4X4_50, not {name!r}")
    size = len(dictionary(name).bytesList)
    if first < 0 or first + count > size:
        raise BadInput(
            f"{name} has {size} markers; the board needs numbers {first} to {first + count - 1}"
        )
