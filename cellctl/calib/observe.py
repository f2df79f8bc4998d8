"""From pictures to views: the same for files of a data set and for pictures of a run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from cellctl.calib.targets import Board
from cellctl.calib.views import Rejection, RobotView, View
from cellctl.geometry import Transform

NOT_FOUND = "the board was not found in the picture"


@dataclass(frozen=True)
class Observed:
    """Views of a board, and the pictures that do not show it."""

    views: list[View] = field(default_factory=list)
    unseen: list[Rejection] = field(default_factory=list)


@dataclass(frozen=True)
class RobotObserved:
    """Views of a board with robot poses, and the pictures that do not show it."""

    views: list[RobotView] = field(default_factory=list)
    unseen: list[Rejection] = field(default_factory=list)


def observe(board: Board, pictures: Iterable[tuple[str, Any]]) -> Observed:
    """Find the board in (id, uint8 picture) pairs; an iterator keeps one picture at a time."""
    found = Observed()
    for name, image in pictures:
        detection = board.detect(image)
        if detection is None:
            found.unseen.append(Rejection(name, NOT_FOUND))
        else:
            found.views.append(View(name, detection.points, detection.pixels))
    return found


def observe_with_robot(
    board: Board, pictures: Iterable[tuple[str, Any, Transform]]
) -> RobotObserved:
    """As `observe`, from (id, uint8 picture, T_base_flange)."""
    found = RobotObserved()
    for name, image, flange in pictures:
        detection = board.detect(image)
        if detection is None:
            found.unseen.append(Rejection(name, NOT_FOUND))
            continue
        view = RobotView(name, detection.points, detection.pixels, flange, board.symmetries)
        found.views.append(view)
    return found
