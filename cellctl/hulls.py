"""Hulls as sets of spheres: one shape for the guard, for occlusion and for parking the arm.

A capsule or a box is covered by spheres that overlap; the cover is never smaller than the shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.arms import JOINTS, ArmModel, Capsule
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Body:
    """Spheres carried by one DH frame: `points` (n, 3) in that frame, `radii` (n,), metres."""

    name: str
    frame: int
    points: Array
    radii: Array

    def world(self, frames: Array) -> Array:
        """Sphere centres (..., n, 3) for link frames (..., 7, 4, 4)."""
        pose = frames[..., self.frame, :, :]
        return self.points @ np.swapaxes(pose[..., :3, :3], -1, -2) + pose[..., None, :3, 3]

    def wrapped(self) -> Body:
        """One sphere around all of them."""
        middle = (self.points.min(axis=0) + self.points.max(axis=0)) / 2
        radius = (np.linalg.norm(self.points - middle, axis=1) + self.radii).max()
        return Body(self.name, self.frame, middle[None], np.array([radius]))


def capsule_body(name: str, capsule: Capsule) -> Body:
    """Spheres that cover a capsule: neighbours one radius apart, radius enlarged by 12 %."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    count = max(int(np.ceil(np.linalg.norm(end - start) / capsule.radius)), 1) + 1
    points = start + (end - start) * np.linspace(0.0, 1.0, count)[:, None]
    half = np.linalg.norm(end - start) / (count - 1) / 2
    return Body(name, capsule.frame, points, np.full(count, np.hypot(capsule.radius, half)))


def box_body(name: str, frame: int, centre: Array, size: Array) -> Body:
    """Spheres that cover a box of `size` (3,) around `centre` (3,), along the axes of `frame`."""
    size = np.asarray(size, dtype=float)
    step = max(size.min(), 0.06)
    counts = np.maximum(np.ceil(size / step).astype(int), 1)
    cell = size / counts
    axes = [(np.arange(n) + 0.5) * c - s / 2 for n, c, s in zip(counts, cell, size, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = float(np.linalg.norm(cell) / 2)
    return Body(name, frame, centre + grid, np.full(len(grid), radius))


def link_bodies(arm: ArmModel) -> tuple[Body, ...]:
    """The arm's own links, base first."""
    return tuple(capsule_body(f"link {link.frame}", link) for link in arm.links)


def pen_body(tip: tuple[float, float, float], radius: float) -> Body:
    """The pen from the flange to its tip, given in the flange frame."""
    return capsule_body("pen", Capsule(JOINTS, (0.0, 0.0, 0.0), tip, radius))
