"""Pictures of drawn lines on a table: coverage of fine samples through the true camera, blur,
light, noise. Nothing here knows how circles are found.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.geometry import Array, invert, look_down

PAPER = 190.0
SUPERSAMPLE = 6

CR = CameraModel(
    np.array([[915.0, 0.0, 958.0], [0.0, 914.0, 548.0], [0.0, 0.0, 1.0]]),
    np.array([0.085, -0.060, 0.0005, -0.0004, 0.012]),
    (1920, 1080),
)
IR = CameraModel(
    np.array([[1830.0, 0.0, 1916.5], [0.0, 1828.0, 1096.5], [0.0, 0.0, 1.0]]),
    np.array([0.085, -0.060, 0.0005, -0.0004, 0.012]),
    (3840, 2160),
)


def above(distance: float, tilt_deg: float = 5.0, azimuth_deg: float = 30.0) -> Array:
    """T_camera_plane (4, 4) of a camera `distance` metres from the plane's origin, looking at it,
    tilted off its normal."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return invert(look_down(distance * away, np.zeros(3)))


@dataclass(frozen=True)
class Ring:
    """A circle about (x, y), metres on the plane; angles are where the pen was down, degrees."""

    x: float
    y: float
    radius: float
    line: float = 0.0008
    ink: float = 0.75
    """Share of the light that it swallows; negative: light that a projector adds."""
    start: float = 0.0
    sweep: float = 360.0

    def box(self) -> Array:
        reach = self.radius + self.line
        return np.array([[self.x - reach, self.y - reach], [self.x + reach, self.y + reach]])

    def cover(self, xy: Array, cell: float) -> Array:
        dx, dy = xy[..., 0] - self.x, xy[..., 1] - self.y
        share = _edge(np.abs(np.hypot(dx, dy) - self.radius) - self.line / 2.0, cell)
        if self.sweep < 360.0:
            angle = (np.degrees(np.arctan2(dy, dx)) - self.start) % 360.0
            share = share * (angle < self.sweep)
        return share


@dataclass(frozen=True)
class Stroke:
    """A straight line between two places."""

    a: tuple[float, float]
    b: tuple[float, float]
    line: float = 0.0008
    ink: float = 0.75

    def box(self) -> Array:
        ends = np.array([self.a, self.b])
        return np.array([ends.min(axis=0) - self.line, ends.max(axis=0) + self.line])

    def cover(self, xy: Array, cell: float) -> Array:
        a, b = np.array(self.a), np.array(self.b)
        along = np.clip(((xy - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        off = np.linalg.norm(xy - a - along[..., None] * (b - a), axis=-1)
        return _edge(off - self.line / 2.0, cell)


@dataclass(frozen=True)
class Block:
    """A filled rectangle: a module of a marker, in ink or in light."""

    low: tuple[float, float]
    high: tuple[float, float]
    ink: float = 0.75

    def box(self) -> Array:
        return np.array([self.low, self.high])

    def cover(self, xy: Array, cell: float) -> Array:
        middle = (np.array(self.low) + self.high) / 2.0
        off = np.abs(xy - middle) - (np.array(self.high) - self.low) / 2.0
        return _edge(off[..., 0], cell) * _edge(off[..., 1], cell)


@dataclass(frozen=True)
class Light:
    """A glare spot of the given strength (grey levels) and radius (metres on the plane), and
    light that falls off across the picture by `uneven`."""

    uneven: float = 0.3
    glare: float = 0.0
    at: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.05


def noisy(clean: Any, seed: int, noise: float = 1.0) -> Any:
    """(h, w) uint8: what the sensor makes of (h, w) float32."""
    rng = np.random.default_rng(seed)
    lit = clean + np.float32(noise) * rng.standard_normal(clean.shape, dtype=np.float32)
    return np.clip(np.rint(lit), 0, 255).astype(np.uint8)


def _edge(signed: Array, cell: float) -> Array:
    return np.clip(0.5 - signed / cell, 0.0, 1.0)


@dataclass
class Sheet:
    """Paper under a camera; things are drawn one upon the other. `blur` is the lens's, pixels,
    and comes before the sensor's sampling."""

    camera: CameraModel
    T: Array
    light: Light = field(default_factory=Light)
    blur: float = 0.7

    def picture(self, things: Any, *, noise: float = 1.0, seed: int = 0) -> Any:
        """(h, w) uint8; `noise` is that of the mean of several pictures."""
        return noisy(self.clean(things), seed, noise)

    def clean(self, things: Any) -> Any:
        """(h, w) float32 without noise."""
        w, h = self.camera.image_size
        reflected = np.ones((h, w), np.float32)
        added = np.zeros((h, w), np.float32)
        for thing in things:
            self._draw(thing, reflected, added)
        return self._lit(reflected, added)

    def project(self, places: Array) -> Array:
        places = np.asarray(places, dtype=float)
        points = np.concatenate([places, np.zeros_like(places[..., :1])], axis=-1)
        return self.camera.project(points @ self.T[:3, :3].T + self.T[:3, 3])

    def _draw(self, thing: Any, reflected: Array, added: Array) -> None:
        (x0, y0), (x1, y1) = thing.box()
        corners = self.project(np.array([(x0, y0), (x1, y0), (x0, y1), (x1, y1)]))
        w, h = self.camera.image_size
        left, top = np.clip(np.floor(corners.min(axis=0)).astype(int) - 5, 0, (w - 1, h - 1))
        right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 6, 1, (w, h))
        if right <= left or bottom <= top:
            return
        places = self._fine_places(left, top, right, bottom)
        cell = float(np.linalg.norm(places[0, 1] - places[0, 0]))
        n = SUPERSAMPLE
        share = cv2.GaussianBlur(thing.cover(places, cell), (0, 0), self.blur * n)
        share = share.reshape(bottom - top, n, right - left, n).mean(axis=(1, 3))
        part = np.s_[top:bottom, left:right]
        if thing.ink >= 0:
            reflected[part] *= 1.0 - thing.ink * share
        else:
            added[part] -= thing.ink * share

    def _fine_places(self, left: int, top: int, right: int, bottom: int) -> Array:
        """Places of samples in a box of pixels: exact at every pixel, linear in between."""
        columns, rows = np.arange(left - 1, right + 1.0), np.arange(top - 1, bottom + 1.0)
        exact = self._places(np.stack(np.meshgrid(columns, rows), axis=-1))
        n = SUPERSAMPLE
        size = (len(columns) * n, len(rows) * n)
        # cv2.resize has pixel centres at half cells: so do samples within a pixel
        fine = [cv2.resize(exact[..., i], size, interpolation=cv2.INTER_LINEAR) for i in (0, 1)]
        return np.stack(fine, axis=-1)[n:-n, n:-n]

    def _places(self, pixels: Array) -> Array:
        rays = self.camera.normalise(pixels)
        H = np.linalg.inv(self.T[:3, [0, 1, 3]])
        mapped = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ H.T
        return mapped[..., :2] / mapped[..., 2:]

    def _lit(self, reflected: Array, added: Array) -> Any:
        w, h = self.camera.image_size
        x = np.linspace(-1.0, 1.0, w, dtype=np.float32)
        y = np.linspace(-1.0, 1.0, h, dtype=np.float32)[:, None]
        level = PAPER * (1.0 - self.light.uneven * (0.35 * x + 0.25 * y * y + 0.2))
        lit = level * reflected * (1.0 + added)
        if self.light.glare:
            centre = self.project(np.array(self.light.at))
            edge = self.project(np.array(self.light.at) + [self.light.radius, 0.0])
            radius = float(np.linalg.norm(edge - centre))
            u = (np.arange(w, dtype=np.float32) - centre[0]) / radius
            v = ((np.arange(h, dtype=np.float32) - centre[1]) / radius)[:, None]
            lit = lit + self.light.glare * np.exp(-0.5 * (u * u + v * v)).astype(np.float32)
        return lit.astype(np.float32)
