"""Paints the things that move onto the picture of the table, each at its own depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cellctl.geometry import Array
from cellctl.sim.bodies import Body
from cellctl.sim.region import Region, bounding
from cellctl.sim.tabletop import AMBIENT, PROJECTOR, WHITE, room_light
from cellctl.sim.textures import Texture, texture
from cellctl.sim.truth import Board, Truth
from cellctl.sim.view import (
    NEAR_M,
    OUTSIDE,
    TILE,
    Capsule,
    Capsules,
    Hits,
    Normal,
    Plate,
    Rays,
    Tiles,
    View,
    meet,
    on_plane,
    tiled,
)

BINNING = 4
"""Margins, depths, light's strength and places on boards are worked out every 4 pixels and
interpolated linearly: at the steepest board that can be read that is off by 0.002 pixels."""
REGION_CAP = 900_000
"""A board that covers more camera pixels than this is not supersampled: it is large enough."""
STRIP = 16
COVER_REACH = 2.0
"""Coarse pixels around a silhouette in which its soft edge can lie."""
SIDE_LIGHT = 0.4
"""Share of the room's light on what faces down; it grows to 1 on what faces up."""
WIDEST_RAY = 1.5
"""Tangent of the angle beyond which the projector surely lights nothing."""

Placed = tuple[Body, Capsule | Plate]
"""A body and its shape in the camera's frame."""
BeamFor = Callable[[str], tuple[Region, Array]]
"""The defocused light that reaches a group of bodies, and where in the projector's picture."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What is seen of a body, every `BINNING` pixels of `region` (in these units). Layers, all
    (h, w) float32: depth; radiance by the room's light; when the projector shines, radiance by
    its white, and the projector pixel (u, v) that lights the place."""

    region: Region
    margin: Array
    layers: dict[str, Array]


@dataclass(eq=False)
class Canvas:
    """Radiance and depth (padded h, w) float32 of the picture that is being painted."""

    grey: Array
    depth: Array


class Painter:
    """Knows the camera's rays, the room's light and what is printed on the boards."""

    def __init__(self, truth: Truth, view: View) -> None:
        self._truth, self._view = truth, view
        self._coarse = View(truth.camera.lens, BINNING)
        self._room = room_light(truth, self._coarse)
        self._textures = {name: texture(name, truth.preset.boards) for name in truth.boards}
        camera = truth.camera.pose.inverse()
        self._up = camera.rotation[:, 2].astype(np.float32)
        self._lamp = camera.apply(truth.projector.pose.translation).astype(np.float32)
        self._T_projector_camera = truth.projector.pose.inverse().matrix @ truth.camera.pose.matrix
        away = truth.projector.pose.translation - truth.table.pose.translation
        self._throw_square = float(away @ away)

    def paint(self, canvas: Canvas, placed: Sequence[Placed], beam: BeamFor | None) -> None:
        """Paint bodies, far ones first; `beam` is None when the projector is dark."""
        for body, shape in placed:
            # The tray covers a board from behind.
            if isinstance(shape, Plate) and (body.name not in self._textures or shape.faces_away()):
                self._plate(canvas, body, shape, beam)
        self._arm(canvas, [(b, s) for b, s in placed if isinstance(s, Capsule)], beam)

    def _plate(self, canvas: Canvas, body: Body, plate: Plate, beam: BeamFor | None) -> None:
        """The tray, plain; a board, with what is printed on it."""
        around = self._coarse.region_of(plate.hull())
        if not around:
            return
        board = self._truth.boards.get(body.name)
        rays = self._coarse.rays[around.slices]
        x, y, depth = board_hit(board, plate.pose, rays) if board else on_plane(plate.pose, rays)
        scale = np.float32(board.scale if board else 1.0)
        margin = plate.margin(x * scale, y * scale, depth)
        found = bounding(margin >= 0)
        if not found:
            return
        found = found.grown(2, margin.shape)
        region, part = found.moved(around.left, around.top), found.slices
        hits = Hits(margin[part], depth[part], plate.normal())
        white = np.array(WHITE * body.albedo, np.float32)
        room = white * self._room[region.slices]
        layers = self._layers(rays[part], hits, white, room, lit=beam is not None)
        surface = Surface(region, hits.margin, layers)
        printed = None
        if board:
            printed = self._printed(self._textures[board.name], x[part], y[part], depth[part])
        self._lay(canvas, surface, beam(body.group) if beam else None, printed)

    def _arm(
        self, canvas: Canvas, placed: Sequence[tuple[Body, Capsule]], beam: BeamFor | None
    ) -> None:
        """All round bodies, merged into one surface before they are laid onto the picture."""
        shapes = Capsules.of([capsule for _, capsule in placed])
        tiles = self._coarse.tiles_of(shapes)
        if not len(tiles.row):
            return
        hits = meet(shapes[tiles.body], tiles.rays)
        white = np.array([WHITE * body.albedo for body, _ in placed], np.float32)
        white = white[tiles.body][:, None, None]
        room = white * tiled(self._room)[tiles.row, tiles.column]
        layers = self._layers(tiles.rays, hits, white, room, lit=beam is not None)
        surface = self._merged(tiles, hits.margin, layers)
        self._lay(canvas, surface, beam("arm") if beam else None, None)

    def _layers(
        self, rays: Rays, hits: Hits, white: Array, room: Array, *, lit: bool
    ) -> dict[str, Array]:
        """Layers of a surface that radiates `white` under light of strength 1, and `room` under
        the room's light from above."""
        layers = {"depth": hits.depth, "room": self._room_on(hits.normal) * room}
        if lit:
            strength, u, v = self._beam_geometry(rays, hits.depth, hits.normal)
            layers |= {"white": white * strength, "u": u, "v": v}
        return layers

    def _merged(self, tiles: Tiles, margins: Array, layers: dict[str, Array]) -> Surface:
        """One surface of many: the nearest where they overlap, the innermost beside them."""
        margin = np.full(self._coarse.padded, OUTSIDE, np.float32)
        merged = {name: np.ones(self._coarse.padded, np.float32) for name in layers}
        for body in np.unique(tiles.body):
            mine, row, column = tiles.of(body)
            behind = tiled(margin)[row, column]
            nearer = layers["depth"][mine] < tiled(merged["depth"])[row, column]
            both = (margins[mine] >= 0) & (behind >= 0)
            front = np.where(both, nearer, margins[mine] > behind)
            tiled(margin)[row, column] = np.maximum(margins[mine], behind)
            for name, picture in merged.items():
                before = tiled(picture)[row, column]
                tiled(picture)[row, column] = np.where(front, layers[name][mine], before)
        (top, bottom), (left, right) = ((a.min(), a.max() + 1) for a in (tiles.row, tiles.column))
        region = Region(int(left), int(top), int(right), int(bottom)).times(TILE)
        cut = {name: picture[region.slices] for name, picture in merged.items()}
        return Surface(region, margin[region.slices], cut)

    def _lay(
        self,
        canvas: Canvas,
        surface: Surface,
        beam: tuple[Region, Array] | None,
        printed: Array | None,
    ) -> None:
        """Lay a surface onto the picture, at full resolution, where it is in front.

        In strips: what a slanting arm does not cover is left alone, and caches are not overrun.
        """
        layers = {name: _rimmed(layer) for name, layer in surface.layers.items()}
        layers["margin"] = _rimmed(surface.margin)
        covered = surface.margin > -COVER_REACH * self._coarse.pixel
        for top in range(0, len(covered), STRIP):
            strip = bounding(covered[top : top + STRIP]).moved(0, top)
            if strip:
                self._lay_strip(canvas, surface.region, strip, layers, beam, printed)

    def _lay_strip(
        self,
        canvas: Canvas,
        region: Region,
        strip: Region,
        layers: dict[str, Array],
        beam: tuple[Region, Array] | None,
        printed: Array | None,
    ) -> None:
        """Of `_lay`: the part `strip` of `region`, both in coarse pixels."""
        full = strip.moved(region.left, region.top).times(BINNING).cropped(canvas.grey.shape)
        inside = (slice(0, full.bottom - full.top), slice(0, full.right - full.left))
        fine = {name: _finer(layer, strip)[inside] for name, layer in layers.items()}
        colour = fine["room"]
        if beam is not None:
            colour += fine["white"] * _light_at(fine["u"], fine["v"], *beam)
        if printed is not None:
            colour *= printed[strip.times(BINNING).slices][inside]
        cover = fine["margin"]
        cover *= np.float32(0.5 / self._view.pixel)
        cover += np.float32(0.5)
        np.clip(cover, 0, 1, out=cover)
        grey, behind = canvas.grey[full.slices], canvas.depth[full.slices]
        cover *= fine["depth"] < behind
        colour -= grey
        colour *= cover
        grey += colour
        np.copyto(behind, fine["depth"], where=cover > 0.5)

    def _printed(self, printed: Texture, x: Array, y: Array, depth: Array) -> Array:
        """Reflectance (h, w) float32 at the camera's resolution."""
        pixels = depth.size * BINNING**2
        fine = 2 if pixels <= REGION_CAP else 1
        level = printed.level_for(float(np.median(depth)) * self._view.pixel / fine)
        places = printed.places(x, y, level)
        whole = Region(0, 0, *depth.shape[::-1])
        fine_places = [_finer(_rimmed(a), whole, BINNING * fine) for a in places]
        sample = printed.sample(fine_places[0], fine_places[1], level)
        sigma = self._truth.preset.camera.defocus_px * fine
        blurred = cv2.GaussianBlur(sample, (0, 0), sigma)
        size = (depth.shape[0] * BINNING, depth.shape[1] * BINNING)
        return _resized(blurred, size, cv2.INTER_AREA) * np.float32(1 / 255)

    def _room_on(self, normal: Normal) -> Array:
        """Room light on surfaces with a normal in the camera's frame."""
        up = sum(n * u for n, u in zip(normal, self._up, strict=True))
        rise = np.float32(AMBIENT * (1 - SIDE_LIGHT) / 2)
        return rise * up + np.float32(AMBIENT * (1 + SIDE_LIGHT) / 2)

    def _beam_geometry(
        self, rays: Rays, depth: Array, normal: Normal
    ) -> tuple[Array, Array, Array]:
        """For points at `depth` along rays: how strongly the projector's white falls on them,
        and the projector pixel (u, v) that lights them."""
        points = (depth * rays.x, depth * rays.y, depth)
        away = [lamp - p for lamp, p in zip(self._lamp, points, strict=True)]
        square = sum(a * a for a in away)
        facing = np.maximum(sum(a * n for a, n in zip(away, normal, strict=True)), 0)
        strength = np.float32(PROJECTOR * self._throw_square) * facing / (square * np.sqrt(square))
        x, y, z = (
            depth * rays.dot(row[:3]) + np.float32(row[3]) for row in self._T_projector_camera[:3]
        )
        z = np.maximum(z, np.float32(NEAR_M))
        x, y = (np.clip(a / z, -WIDEST_RAY, WIDEST_RAY) for a in (x, y))
        pixels = self._truth.projector.lens.pixels(x, y)
        return strength, pixels[..., 0], pixels[..., 1]


def board_hit(board: Board, pose: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Where rays meet a bent sheet at `pose` (4, 4): nominal printed x and y, and the depth.

    The inverse of `Board.surface`, to the first order of the bend.
    """
    x, y, depth = on_plane(pose, rays)
    axis = int(np.argmax(board.half))
    along = (x, y)[axis] * np.float32(1 / board.scale) - np.float32(board.centre[axis])
    sag = np.float32(board.bend) * (1 - (along * np.float32(1 / board.half[axis])) ** 2)
    deeper = sag / rays.dot(pose[:3, 2])  # the way along the ray that sinks by `sag`
    x, y = (
        (a + deeper * rays.dot(pose[:3, i])) * np.float32(1 / board.scale)
        for i, a in enumerate((x, y))
    )
    return x, y, depth + deeper


def _light_at(u: Array, v: Array, region: Region, light: Array) -> Array:
    """The projector's picture, of which `light` is the part `region`, at its pixels (u, v)."""
    if not region:
        return np.zeros_like(u)
    columns, rows = u - np.float32(region.left), v - np.float32(region.top)
    return cv2.remap(light, columns, rows, cv2.INTER_LINEAR)


def _rimmed(values: Array) -> Array:
    """With a rim of one more value on every side, continued linearly."""
    return np.pad(values, 1, mode="reflect", reflect_type="odd")


def _finer(rimmed: Array, part: Region, n: int = BINNING) -> Array:
    """What is given at the middles of n x n blocks, at every pixel of the blocks of `part`."""
    around = rimmed[part.top : part.bottom + 2, part.left : part.right + 2]
    fine = cv2.resize(around, None, fx=n, fy=n, interpolation=cv2.INTER_LINEAR)
    return fine[n:-n, n:-n]


def _resized(picture: Array, shape: tuple[int, int], how: int = cv2.INTER_LINEAR) -> Array:
    resized: Array = cv2.resize(picture, (shape[1], shape[0]), interpolation=how)
    return resized
