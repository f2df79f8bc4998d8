"""From pictures to views: the same for files of a data set and for pictures of a run.

What a picture cannot be used for is told by its name: no board in it, the same picture twice, or
blurred edges.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from cellctl.calib.pose import on_a_line
from cellctl.calib.printed import NOT_FOUND, Unseen
from cellctl.calib.sharpness import TOO_BLURRED_PX, sharpness
from cellctl.calib.targets import Board, Detection
from cellctl.calib.views import AnyView, Rejection, RobotView, View
from cellctl.geometry import Array, Transform, invert, rotation_angle

__all__ = ["NOT_FOUND", "Observed", "observe", "observe_with_robot"]

BLURRED = 2.0
"""A view is blurred when its edges are that many times as wide as the median view's, and wider
than TOO_BLURRED_PX: a whole set may be taken out of focus, which costs noise and no more."""
SAME_M, SAME_RAD = 1e-3, np.radians(0.1)
"""Robot poses that differ by less are the same: a pose read twice differs by its noise."""


@dataclass(frozen=True)
class Observed(Generic[AnyView]):
    """Views of a board, and the pictures that yield none, with the reason. `sights`: in how many
    pictures the board was seen, good views or not."""

    views: list[AnyView]
    unseen: list[Rejection]
    sights: int


@dataclass(frozen=True, eq=False)
class _Sight:
    """A view, its picture's fingerprint, and the width of the printed edges in px."""

    view: View
    digest: bytes
    edge_px: float


def observe(board: Board, pictures: Iterable[tuple[str, Any]]) -> Observed[View]:
    """Find the board in (id, uint8 picture) pairs; an iterator keeps one picture at a time."""
    sights, unseen = _look(board, pictures)
    bad = {**_blurred(sights), **_repeated(sights)}
    return _without(bad, [sight.view for sight in sights], unseen)


def observe_with_robot(
    board: Board, pictures: Iterable[tuple[str, Any, Transform]]
) -> Observed[RobotView]:
    """As `observe`, from (id, uint8 picture, T_base_flange)."""
    flanges: dict[str, Transform] = {}

    def remembered() -> Iterator[tuple[str, Any]]:
        for name, image, flange in pictures:
            flanges[name] = flange
            yield name, image

    sights, unseen = _look(board, remembered())
    bad = {**_blurred(sights), **_repeated(sights, flanges)}
    views = [
        RobotView(view.id, view.points, view.pixels, flanges[view.id], board.symmetries)
        for view in (sight.view for sight in sights)
    ]
    return _without(bad, views, unseen)


def _look(
    board: Board, pictures: Iterable[tuple[str, Any]]
) -> tuple[list[_Sight], list[Rejection]]:
    sights, unseen = [], []
    for name, image in pictures:
        found = board.look(image)
        if isinstance(found, Unseen):
            unseen.append(Rejection(name, found.reason))
            continue
        digest = hashlib.sha256(np.asarray(image).tobytes()).digest()
        view = View(name, found.points, found.pixels)
        sights.append(_Sight(view, digest, _edge_px(image, found)))
    return sights, unseen


def _edge_px(image: Any, found: Detection) -> float:
    """Infinite also where too little of the board is seen to tell where its edges are."""
    return float("inf") if on_a_line(found.points) else sharpness(image, found)


def _blurred(sights: Sequence[_Sight]) -> dict[str, str]:
    """Why not, by id. A view whose edges cannot be measured is not judged by them."""
    widths = {s.view.id: s.edge_px for s in sights if np.isfinite(s.edge_px)}
    median = float(np.median(list(widths.values()))) if widths else 0.0
    limit = max(TOO_BLURRED_PX, BLURRED * median)
    return {
        name: f"blurred: its edges are {width:.1f} px wide, those of the median view {median:.1f}"
        for name, width in widths.items()
        if width > limit
    }


def _repeated(
    sights: Sequence[_Sight], flanges: dict[str, Transform] | None = None
) -> dict[str, str]:
    """Why not, by id. Of the same picture at one robot pose the first is kept; at several none
    is, for nothing tells which of the poses is its own."""
    groups: dict[bytes, list[str]] = {}
    for sight in sights:
        groups.setdefault(sight.digest, []).append(sight.view.id)
    bad = {}
    for first, *others in groups.values():
        apart = flanges is not None and not all(_same(flanges[first], flanges[o]) for o in others)
        for name in [first, *others] if apart else others:
            other = others[0] if name == first else first
            where = " but at another robot pose: one of them is mislabelled" if apart else ""
            bad[name] = f"the same picture as view {other!r}{where}"
    return bad


def _same(one: Transform, other: Transform) -> bool:
    off: Array = invert(one.matrix) @ other.matrix
    return bool(np.linalg.norm(off[:3, 3]) < SAME_M and rotation_angle(off) < SAME_RAD)


def _without(
    bad: dict[str, str], views: Sequence[AnyView], unseen: Sequence[Rejection]
) -> Observed[AnyView]:
    rejected = [Rejection(name, reason) for name, reason in bad.items()]
    return Observed([v for v in views if v.id not in bad], [*unseen, *rejected], len(views))
