"""What the camera sees: table, projected light, shadows, boards and arm, without sensor noise.

The projector's pixels light the table, the boards and the arm where they truly are. Edges that a
detector measures (printed and projected) are anti-aliased without bias; silhouettes have soft
edges. Not modelled: light reflected from one thing onto another, and shadows of one link of the
arm on another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from cellctl.drivers.base import Image
from cellctl.geometry import Array
from cellctl.sim.bodies import bodies
from cellctl.sim.light import Beam, Light, Shadows, mixed
from cellctl.sim.noise import NoiseBank
from cellctl.sim.paint import BeamFor, Canvas, Painter, Placed
from cellctl.sim.paper import Ink
from cellctl.sim.presets import CameraPreset
from cellctl.sim.region import Region
from cellctl.sim.tabletop import Tabletop
from cellctl.sim.truth import Truth
from cellctl.sim.view import Capsule, Plate, View


@dataclass(frozen=True, eq=False)
class Instant:
    """A part of an exposure: its `share`, the arm's true link frames (7, 4, 4), the light."""

    share: float
    frames: Array
    light: Light


@dataclass(frozen=True, eq=False)
class LitTable:
    """The projector's light (h, w), the same defocused (both None when it is dark), and the
    table's radiance (padded camera h, w) under it without shadows."""

    light: Array | None
    smooth: Array | None
    radiance: Array


class Optics:
    """Renders for one truth. Not thread-safe: it keeps what it can use again."""

    def __init__(self, truth: Truth) -> None:
        self._view = View(truth.camera.lens)
        self._table = Tabletop(truth, self._view)
        self._painter = Painter(truth, self._view)
        self._beam = Beam(truth)
        self._bodies = bodies(truth)
        self._T_camera_world = truth.camera.pose.inverse().matrix
        self._table_lit: tuple[object, LitTable] | None = None
        self._still: tuple[object, Array] | None = None

    def expose(self, instants: tuple[Instant, ...], ink: Ink = ()) -> Array:
        """The mean signal (h, w) float32 of an exposure, grey levels above the sensor's offset."""
        self._take_in(ink)
        height, width = self._view.shape
        if len(instants) == 1:
            return self._still_signal(instants[0])[:height, :width]
        total = np.zeros(self._view.padded, dtype=np.float32)
        for instant in instants:
            cv2.scaleAdd(self._signal(instant), instant.share, total, dst=total)
        return total[:height, :width]

    def _take_in(self, ink: Ink) -> None:
        """Bring what is kept up to date where ink has come or gone."""
        changed = self._table.take_in(ink)
        if not changed:
            return
        self._still = None
        if self._table_lit is not None:
            _, table = self._table_lit
            for region in changed:
                table.radiance[region.slices] = self._table.lit(table.smooth, region)

    def _still_signal(self, instant: Instant) -> Array:
        """Of a cell in which nothing moves; kept, as pictures are taken several at a time."""
        key = (_key(instant.light), instant.frames.tobytes())
        if self._still is None or self._still[0] != key:
            self._still = key, self._signal(instant)
        return self._still[1]

    def _signal(self, instant: Instant) -> Array:
        table = self._lit_table(instant.light)
        canvas = Canvas(table.radiance.copy(), self._table.depth.copy())
        beam = self._shade(canvas, table, instant.frames)
        self._painter.paint(canvas, self._far_to_near(instant.frames), beam)
        return canvas.grey

    def _lit_table(self, light: Light) -> LitTable:
        key = _key(light)
        if self._table_lit is None or self._table_lit[0] != key:
            self._table_lit = key, self._light_table(mixed(light))
        return self._table_lit[1]

    def _light_table(self, light: Array | None) -> LitTable:
        if light is None:
            return LitTable(None, None, self._table.lit(None))
        smooth = self._blur(light)
        return LitTable(light, smooth, self._table.lit(smooth))

    def _blur(self, light: Array) -> Array:
        return cv2.GaussianBlur(light, (0, 0), self._table.defocus, borderType=cv2.BORDER_CONSTANT)

    def _shade(self, canvas: Canvas, table: LitTable, frames: Array) -> BeamFor | None:
        """Take away the light that does not reach the table; says what reaches the bodies."""
        if table.light is None or table.smooth is None:
            return None
        light, shadows = table.light, self._beam.cast(self._bodies, frames)
        shaded = shadows.region()
        seen = self._table.seen(shaded) if shaded else shaded
        if seen:
            smooth = table.smooth.copy()
            smooth[shaded.slices] = self._masked(light, shadows, shaded, None)
            canvas.grey[seen.slices] = self._table.lit(smooth, seen)

        @lru_cache
        def reaching(group: str) -> tuple[Region, Array]:
            region = shadows.region(group)
            return region, self._masked(light, shadows, region, group)

        return reaching

    def _masked(self, light: Array, shadows: Shadows, part: Region, group: str | None) -> Array:
        """The light that reaches `group` (None: the table) in `part` of the projector's picture,
        defocused together with what surrounds it."""
        wide = part.grown(int(np.ceil(4 * self._table.defocus)) + 1, light.shape)
        blurred = self._blur(light[wide.slices] * shadows.mask(wide, group))
        top, left = part.top - wide.top, part.left - wide.left
        return blurred[top : top + part.bottom - part.top, left : left + part.right - part.left]

    def _far_to_near(self, frames: Array) -> list[Placed]:
        placed = [(body, body.placed(frames, self._T_camera_world)) for body in self._bodies]
        return sorted(placed, key=lambda pair: _depth(pair[1]), reverse=True)


class Renderer:
    """Pictures of one world, whose truth may change when a device is nudged."""

    def __init__(self, seed: int, preset: CameraPreset) -> None:
        width, height = preset.size_px
        self._noise = NoiseBank(seed, (height, width), preset.noise_sigma)
        self._optics: tuple[Truth, Optics] | None = None

    def picture(
        self, truth: Truth, instants: tuple[Instant, ...], index: str, ink: Ink = ()
    ) -> Image:
        """The uint8 picture (h, w) of an exposure, with the sensor noise of `index`."""
        if self._optics is None or self._optics[0] is not truth:
            self._optics = truth, Optics(truth)
        return self._noise.expose(self._optics[1].expose(instants, ink), index)


def _key(light: Light) -> object:
    return [(share, picture and picture.number) for share, picture in light]


def _depth(shape: Capsule | Plate) -> float:
    hull = shape.hull() if isinstance(shape, Plate) else shape
    return float(hull.start[2] + hull.end[2])
