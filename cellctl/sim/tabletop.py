"""The table as the camera sees it: what neither moves nor changes, and the ink on it.

Radiance is in grey levels above the sensor's pedestal; light is linear, 1 = the projector's
white at the middle of its image.
"""

from __future__ import annotations

import cv2
import numpy as np

from cellctl.geometry import Array
from cellctl.sim.inking import Inking, paper
from cellctl.sim.noise import keyed
from cellctl.sim.paper import Ink
from cellctl.sim.region import NOWHERE, Region
from cellctl.sim.truth import Truth
from cellctl.sim.view import TILE, View, dense

AMBIENT, PROJECTOR = 0.55, 0.45
"""What a white sheet reflects of the room's and of the projector's light; 1 saturates."""
WHITE = 255.0
TABLE_ALBEDO, PAPER_ALBEDO, FLOOR_ALBEDO, MOTTLE = 0.75, 0.77, 0.12, 0.015
GLARE_PEAK, GLARE_WIDTH = 220.0, 0.012
PIXEL_BOX_VARIANCE = 1.0 / 12.0


def beam_strength(truth: Truth, points: Array, normal: Array) -> Array:
    """Irradiance (...,) by the projector's white at world points (..., 3) of surfaces with this
    unit `normal` (3,); 1 at the middle of the table. Back sides get none."""
    origin = truth.projector.pose.translation
    middle = truth.table.pose.translation
    towards = (origin - points).astype(points.dtype)
    square = (towards**2).sum(-1)
    cosine = (towards @ normal.astype(points.dtype)) / np.sqrt(square)
    return np.maximum(cosine, 0) * np.float32(((origin - middle) ** 2).sum()) / square


def room_light(truth: Truth, view: View) -> Array:
    """(padded h, w) float32 in the camera's image: 1 where the room's light is strongest, falling
    by the preset's unevenness towards the farthest corner."""
    rng = keyed(truth.seed, "room", "")
    size = np.array(truth.camera.lens.size)
    bright = rng.uniform(0.2, 0.8, 2) * size
    rows, columns = (
        (np.arange(n, dtype=np.float32) * view.binning + (view.binning - 1) / 2 - centre) ** 2
        for n, centre in zip(view.padded, bright[::-1], strict=True)
    )
    farthest = (np.maximum(bright, size - bright) ** 2).sum()
    fall = truth.preset.camera.unevenness / farthest
    return (1.0 - fall * np.add.outer(rows, columns)).astype(np.float32)


class Tabletop:
    """Layers (padded h, w): `ambient` radiance, `gain` of projected light, `depth`. The first two
    are changed where ink is taken in, and nowhere else."""

    def __init__(self, truth: Truth, view: View) -> None:
        self._truth, self._view = truth, view
        self._inking: Inking | None = None
        u, v, self.depth, strength, *places = dense(self._look, view.padded, TILE)
        albedo = self._albedo(*places)
        self.ambient = (
            np.float32(WHITE * AMBIENT) * room_light(truth, view) * albedo + self._glare()
        )
        self.gain = np.float32(WHITE * PROJECTOR) * albedo * strength
        self._blank = self.ambient, self.gain
        self._maps, self._places = (u, v), (places[0], places[1])
        self.defocus = self._defocus()

    def take_in(self, ink: Ink) -> list[Region]:
        """Show this ink and no other; returns where the layers have changed."""
        if self._inking is None:
            if not ink:
                return []
            self._inking = Inking(self._truth, self._places)
            self.ambient, self.gain = (layer.copy() for layer in self._blank)
        changed = self._inking.show(ink)
        for region in changed:
            part = region.slices
            for layer, blank in zip((self.ambient, self.gain), self._blank, strict=True):
                np.multiply(blank[part], self._inking.left[part], out=layer[part])
        return changed

    def lit(self, smooth: Array | None, region: Region | None = None) -> Array:
        """Radiance of the table under the light `smooth` (projector h, w; None: dark), of a camera
        region."""
        part = (slice(None), slice(None)) if region is None else region.slices
        if smooth is None:
            return self.ambient[part].copy()
        u, v = (m[part] for m in self._maps)
        light: Array = cv2.remap(smooth, u, v, cv2.INTER_LINEAR)
        light *= self.gain[part]
        light += self.ambient[part]
        return light

    def seen(self, beam: Region) -> Region:
        """Camera region in which projector pixels of `beam` can be seen on the table."""
        edge = np.linspace(0.0, 1.0, 9)
        u = beam.left + edge * (beam.right - beam.left)
        v = beam.top + edge * (beam.bottom - beam.top)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        pixels = self._truth.camera.project(self._truth.light_lands(grid))
        low, high = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
        box = Region(*np.maximum([*low, *high], 0).astype(int).tolist())
        return box.grown(2, self._view.padded) or NOWHERE

    def _look(self, pixels: Array) -> Array:
        """Camera pixels (..., 2) -> projector pixel (2), depth, beam, place on the table (2)."""
        truth = self._truth
        camera = truth.camera.pose
        points = truth.table.hit(camera.translation, truth.camera.rays(pixels))
        depth = (points - camera.translation) @ camera.rotation[:, 2]
        strength = beam_strength(truth, points, truth.table.pose.rotation[:, 2])
        places = truth.table.pose.inverse().apply(points)[..., :2]
        lit = truth.projector.project(points)
        return np.concatenate([lit, depth[..., None], strength[..., None], places], axis=-1)

    def _albedo(self, x: Array, y: Array) -> Array:
        """Paper on a matt top, slightly mottled, on a floor that is darker and far away."""
        pixel = self._truth.preset.camera.height_m * self._view.pixel
        hx, hy = self._truth.table.half_top.astype(np.float32)
        inside = np.minimum(hx - np.abs(x), hy - np.abs(y))
        on_top, on_paper = (
            np.clip(margin / np.float32(pixel) + np.float32(0.5), 0, 1)
            for margin in (inside, paper(self._truth.sheets, x, y))
        )
        rows, columns = self._view.padded
        rng = keyed(self._truth.seed, "mottle", "")
        blotches = rng.standard_normal((rows // 6, columns // 6), dtype=np.float32)
        mottle = cv2.resize(blotches, (columns, rows), interpolation=cv2.INTER_CUBIC)
        bright = np.float32(PAPER_ALBEDO - TABLE_ALBEDO) * on_paper + np.float32(TABLE_ALBEDO)
        bright *= 1 + np.float32(MOTTLE) * mottle
        return np.float32(FLOOR_ALBEDO) + on_top * (bright - np.float32(FLOOR_ALBEDO))

    def _glare(self) -> Array:
        """The lamp's reflection, somewhere in the lit area."""
        truth = self._truth
        rng = keyed(truth.seed, "glare", "")
        spot = np.array([*(rng.uniform(-0.8, 0.8, 2) * truth.table.half_lit), 0.0])
        centre = truth.camera.project(truth.table.pose.apply(spot))
        width = GLARE_WIDTH * truth.camera.lens.size[0]
        rows, columns = (np.arange(n) for n in self._view.padded)
        across = np.exp(-((columns - centre[0]) ** 2) / (2 * width**2))
        down = np.exp(-((rows - centre[1]) ** 2) / (2 * width**2))
        return (GLARE_PEAK * np.outer(down, across)).astype(np.float32)

    def _defocus(self) -> float:
        """The camera's blur, its pixels' own included, in projector pixels on the table.

        It is applied to the projector's picture, where it is sampled finely, not to the camera's.
        """
        middle = self._truth.camera.project(self._truth.table.pose.translation)
        column, row = middle.astype(int)
        steps = [
            [m[row, column + 1] - m[row, column], m[row + 1, column] - m[row, column]]
            for m in self._maps
        ]
        scale = np.sqrt(abs(np.linalg.det(np.array(steps, dtype=float))))
        return float(
            scale * np.hypot(self._truth.preset.camera.defocus_px, PIXEL_BOX_VARIANCE**0.5)
        )
