"""When the arm, or what it carries, touches something: true hulls against the true cell.

Hulls are sampled as balls: links along their axes, boards and tray on a grid. Links are not
checked against each other, but what the bracket carries is checked against the links. The pen may
be pressed onto the table as far as its holder gives way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.geometry import Array, Mask
from cellctl.sim.bodies import Body, bodies, plate_points
from cellctl.sim.truth import Truth
from cellctl.sim.view import Capsule, Plate

SHEET_SPACING_M = 0.04
SHEET_RADIUS_M = 0.002
FOREARM = 3
"""Links up to this DH frame are what the bracket could be swung into."""
SWUNG = ("tray", "pen")
"""What is checked against them; the boards lie on the tray."""
DEVICES, TABLE, ARM = ("camera", "projector"), "table", "arm"


@dataclass(frozen=True, eq=False)
class Balls:
    """Sample points (n, 3) of one body in its DH frame `frame`, and their radius; `pressed`
    (n, 3) are the points when the body is pressed onto the table."""

    name: str
    frame: int
    points: Array
    radius: float
    pressed: Array


@dataclass(frozen=True)
class Contact:
    """The smallest `gap` in metres (negative: they overlap), and between what."""

    gap: float
    between: tuple[str, str]


class Obstacles:
    """What the arm of one truth can touch."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        travel = truth.preset.pen.travel_m
        self._balls = [_balls(body, travel) for body in bodies(truth) if body.frame > 0]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """What can touch what."""
        return [(balls.name, other) for balls in self._balls for other in self._others(balls)]

    def gaps(self, frames: Array, which: Mask | None = None) -> Array:
        """Gaps (n, k) at true link frames (n, 7, 4, 4), of the `pairs` that `which` marks."""
        wanted = iter(np.ones(len(self.pairs), bool) if which is None else which)
        columns = []
        for balls in self._balls:
            others = [other for other in self._others(balls) if next(wanted)]
            at = frames[:, balls.frame]
            points = _moved(at, balls.points) if set(others) - {TABLE} else np.empty((0, 0, 3))
            for other in others:
                near = _moved(at, balls.pressed) if other == TABLE else points
                columns.append(self._to(other, near, frames) - balls.radius)
        return np.stack(columns, axis=1)

    def nearest(self, frames: Array) -> Contact:
        """The smallest gap at one set of link frames (7, 4, 4)."""
        gaps = self.gaps(frames[None])[0]
        pair = int(gaps.argmin())
        return Contact(float(gaps[pair]), self.pairs[pair])

    def _others(self, balls: Balls) -> tuple[str, ...]:
        return (*DEVICES, TABLE, ARM) if balls.name in SWUNG else (*DEVICES, TABLE)

    def _to(self, other: str, points: Array, frames: Array) -> Array:
        """Gaps (n,) from points (n, k, 3) in the world to one other thing."""
        if other == TABLE:
            return np.asarray(self._above_table(points).min(axis=1))
        if other == ARM:
            return self._to_links(points, frames)
        truth = self._truth
        device = truth.camera if other == "camera" else truth.projector
        away = _distance(points, device.pose.translation).min(axis=1)
        return np.asarray(away - truth.preset.body_radius_m)

    def _above_table(self, points: Array) -> Array:
        """Height (...,) over the table top; beside it, the distance to its upper edge."""
        table = self._truth.table
        places = table.pose.inverse().apply(points)
        height = places[..., 2] - table.height(places[..., :2])
        beside = np.linalg.norm(np.maximum(np.abs(places[..., :2]) - table.half_top, 0), axis=-1)
        return np.where(beside > 0, np.hypot(beside, np.maximum(height, 0)), height)

    def _to_links(self, points: Array, frames: Array) -> Array:
        """Smallest gap (n,) from points (n, k, 3) to the links up to the forearm."""
        gaps = np.full(len(points), np.inf)
        for link in self._truth.arm.links:
            if link.frame > FOREARM:
                continue
            ends = _moved(frames[:, link.frame], np.array([link.start, link.end]))
            distance = _to_segments(points, ends[:, 0], ends[:, 1]).min(axis=1)
            gaps = np.minimum(gaps, distance - link.radius)
        return gaps


def _balls(body: Body, pen_travel: float) -> Balls:
    if isinstance(body.shape, Plate):
        points, radius = plate_points(body.shape, SHEET_SPACING_M), SHEET_RADIUS_M
    else:
        points, radius = _along(body.shape), body.shape.radius
    shorter = (0.0, 0.0, pen_travel if body.name == "pen" else 0.0)
    return Balls(body.name, body.frame, points, radius, points - shorter)


def _along(capsule: Capsule) -> Array:
    length = float(np.linalg.norm(capsule.end - capsule.start))
    steps = np.linspace(0.0, 1.0, 2 + int(length / max(capsule.radius, 0.01)))
    return capsule.start + steps[:, None] * (capsule.end - capsule.start)


def _moved(poses: Array, points: Array) -> Array:
    """(n, k, 3) of points (k, 3) under poses (n, 4, 4)."""
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _distance(points: Array, place: Array) -> Array:
    away = points - place
    return np.sqrt(np.einsum("nkd,nkd->nk", away, away))


def _to_segments(points: Array, starts: Array, ends: Array) -> Array:
    """Distances (n, k) of points (n, k, 3) from one segment each, ends (n, 3)."""
    axes, away = ends - starts, points - starts[:, None]
    square = np.maximum((axes**2).sum(-1), 1e-12)[:, None]
    along = np.einsum("nkd,nd->nk", away, axes)
    nearest = np.clip(along / square, 0.0, 1.0)
    distance = np.einsum("nkd,nkd->nk", away, away) + nearest * (nearest * square - 2 * along)
    return np.sqrt(np.maximum(distance, 0.0))
