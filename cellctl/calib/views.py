"""What the solvers work on: one view is one picture of a board, reduced to points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform


@dataclass(frozen=True, eq=False)
class View:
    """`points` (n, 3) on the board, metres, and where the picture has them, `pixels` (n, 2)."""

    id: str
    points: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class RobotView(View):
    """A view with the pose that the robot reported for it (parent: its base or the world).

    `symmetries` (s, 4, 4) are the turns of the board, in its own frame, that its print does not
    show, the identity first: a board with odd x odd inner corners looks the same after half a
    turn, and a finder may number its corners from either end.
    """

    T_base_flange: Transform
    symmetries: Array = field(default_factory=lambda: np.eye(4)[None])


@dataclass(frozen=True)
class Rejection:
    """A view or marker that the solution does not rest on, and why, in words."""

    id: str
    reason: str

    def to_dict(self) -> dict[str, str]:
        return {"id": self.id, "reason": self.reason}


def shortage(used: int, rejected: int, least: int, share: float) -> list[str]:
    """Reasons against a verdict, and what to do: fewer than `least` views used, more than `share`
    rejected."""
    reasons = []
    if used < least:
        reasons.append(f"only {used} views could be used; at least {least} are needed: add views")
    if rejected > share * (used + rejected):
        reasons.append(
            f"{rejected} of {used + rejected} views were rejected: see why, view by view, "
            "and take them again"
        )
    return reasons


AnyView = TypeVar("AnyView", bound=View)


def ordered(views: Iterable[AnyView]) -> list[AnyView]:
    """Sorted by id, so that a result does not depend on the order of its input.

    BadInput when two views carry the same id.
    """
    views = sorted(views, key=lambda view: view.id)
    twice = [name for name, count in Counter(view.id for view in views).items() if count > 1]
    if twice:
        raise BadInput(f"the view id {twice[0]!r} is used more than once")
    return views


@dataclass(frozen=True, eq=False)
class Batch:
    """Views side by side: `points` (n, k, 3), `pixels` (n, k, 2), `seen` (n, k); k is the largest
    number of points in a view, and what a view lacks is not `seen`."""

    points: Array
    pixels: Array
    seen: Array

    @classmethod
    def of(cls, views: Sequence[View]) -> Batch:
        k = max((len(view.points) for view in views), default=0)
        points = np.zeros((len(views), k, 3))
        pixels = np.zeros((len(views), k, 2))
        seen = np.zeros((len(views), k), dtype=bool)
        for i, view in enumerate(views):
            count = len(view.points)
            points[i, :count], pixels[i, :count], seen[i, :count] = view.points, view.pixels, True
        return cls(points, pixels, seen)

    def __getitem__(self, index: Any) -> Batch:
        return Batch(self.points[index], self.pixels[index], self.seen[index])


def rms(errors: Array) -> float:
    """Root mean square length of 2-D errors (..., 2): sqrt(mean(dx^2 + dy^2))."""
    squares = np.square(np.reshape(errors, (-1, 2))).sum(axis=1)
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def excess(errors: Sequence[Array], best: Sequence[Array]) -> float:
    """By how much the squares of held-out errors, one (k, 2) a view, exceed those of the best
    solution, less one standard error of the difference, paired by view.

    Not positive: the data do not tell the two apart. The one-standard-error rule of Breiman et
    al., Classification and Regression Trees, 1984, section 3.4.3.
    """
    pairs = zip(errors, best, strict=True)
    difference = np.array([np.square(one).sum() - np.square(other).sum() for one, other in pairs])
    n = len(difference)
    return float(difference.sum() - np.sqrt(n) * difference.std(ddof=1 if n > 1 else 0))


def noise_px(errors: Array) -> float:
    """Standard deviation of a coordinate, from the median length of errors (n, 2): Rayleigh's.
    Never below 0.001 px, so that perfect data remain solvable."""
    return max(float(np.median(np.linalg.norm(errors, axis=-1))) / 1.1774, 1e-3)
