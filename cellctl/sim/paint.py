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
SIDE_LIGHT = 0.4
"""Share of the room's light on what faces down; it grows to 1 on what faces up."""
WIDEST_RAY = 1.5
"""Tangent of the angle beyond which the projector surely lights nothing."""

Placed = tuple[Body, Capsule | Plate]
"""A body and its shape in the camera's frame."""
BeamFor = Callable[[str], tuple[Region, Array]]
"""The defocused light that reaches a group of bodies, and where in the projector's picture."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Part of a body's surface, every `BINNING` pixels of the region `small` of the binned
    picture; all arrays (h, w) float32."""

    small: Region
    rays: Rays
    margin: Array
    depth: Array


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
        self._room, self._coarse_room = room_light(truth, view), room_light(truth, self._coarse)
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
        region = self._coarse.region_of(plate.hull())
        if not region:
            return
        board = self._truth.boards.get(body.name)
        rays = self._coarse.rays[region.slices]
        x, y, depth = board_hit(board, plate.pose, rays) if board else on_plane(plate.pose, rays)
        scale = board.scale if board else 1.0
        margin = plate.margin(x * np.float32(scale), y * np.float32(scale), depth)
        found = bounding(margin >= 0).grown(2, margin.shape)
        part = found.slices
        patch = Patch(found.moved(region.left, region.top), rays[part], margin[part], depth[part])
        full = patch.small.times(BINNING).cropped(canvas.grey.shape)
        if not full:
            return
        normal = plate.normal()
        light = self._room_on(normal) * self._room[full.slices]
        if beam is not None:
            strength, u, v = self._beam_geometry(patch.rays, patch.depth, normal)
            strength, u, v = (_finer(a, BINNING)[_inside(full)] for a in (strength, u, v))
            light += strength * _light_at(u, v, *beam(body.group))
        if board:
            light *= self._printed(self._textures[board.name], x[part], y[part], patch.depth)[
                _inside(full)
            ]
        light *= np.float32(WHITE * body.albedo)
        self._lay(canvas, full, patch, light)

    def _arm(
        self, canvas: Canvas, placed: Sequence[tuple[Body, Capsule]], beam: BeamFor | None
    ) -> None:
        """All round bodies, merged into one patch before they are laid onto the picture."""
        shapes = Capsules.of([capsule for _, capsule in placed])
        tiles = self._coarse.tiles_of(shapes)
        if not len(tiles.row):
            return
        hits = meet(shapes[tiles.body], tiles.rays)
        albedo = np.array([WHITE * body.albedo for body, _ in placed], np.float32)[tiles.body]
        room = tiled(self._coarse_room)[tiles.row, tiles.column]
        layers = {
            "depth": hits.depth,
            "room": albedo[:, None, None] * self._room_on(hits.normal) * room,
        }
        if beam is not None:
            strength, u, v = self._beam_geometry(tiles.rays, hits.depth, hits.normal)
            layers |= {"strength": albedo[:, None, None] * strength, "u": u, "v": v}
        margin, merged = self._merged(tiles, hits, layers)
        small = _around(tiles.row, tiles.column)
        full = small.times(BINNING).cropped(canvas.grey.shape)
        merged = {k: v[small.slices] for k, v in merged.items()}
        light = _finer(merged["room"], BINNING)[_inside(full)]
        if beam is not None:
            strength, u, v = (
                _finer(merged[k], BINNING)[_inside(full)] for k in ("strength", "u", "v")
            )
            light += strength * _light_at(u, v, *beam("arm"))
        patch = Patch(small, self._coarse.rays[small.slices], margin[small.slices], merged["depth"])
        self._lay(canvas, full, patch, light)

    def _merged(
        self, tiles: Tiles, hits: Hits, layers: dict[str, Array]
    ) -> tuple[Array, dict[str, Array]]:
        margin = np.full(self._coarse.padded, OUTSIDE, np.float32)
        merged = {k: np.zeros(self._coarse.padded, np.float32) for k in layers}
        merged["depth"][:] = 1.0
        for body in np.unique(tiles.body):
            mine, row, column = tiles.of(body)
            m, d = hits.margin[mine], hits.depth[mine]
            bm, bd = tiled(margin)[row, column], tiled(merged["depth"])[row, column]
            front = np.where((m >= 0) & (bm >= 0), d < bd, m > bm)
            tiled(margin)[row, column] = np.maximum(m, bm)
            for k, picture in merged.items():
                before = tiled(picture)[row, column]
                tiled(picture)[row, column] = np.where(front, layers[k][mine], before)
        return margin, merged

    def _lay(self, canvas: Canvas, full: Region, patch: Patch, colour: Array) -> None:
        """Lay a patch onto the picture where it is in front."""
        margin, depth = (_finer(a, BINNING)[_inside(full)] for a in (patch.margin, patch.depth))
        cover = np.clip(margin * np.float32(0.5 / self._view.pixel) + np.float32(0.5), 0, 1)
        grey, before = canvas.grey[full.slices], canvas.depth[full.slices]
        cover *= depth < before
        grey += cover * (colour - grey)
        np.copyto(before, depth, where=cover > 0.5)

    def _printed(self, printed: Texture, x: Array, y: Array, depth: Array) -> Array:
        """Reflectance (h, w) float32 at the camera's resolution."""
        pixels = depth.size * BINNING**2
        fine = 2 if pixels <= REGION_CAP else 1
        level = printed.level_for(float(np.median(depth)) * self._view.pixel / fine)
        places = printed.places(x, y, level)
        sample = printed.sample(_finer(places, BINNING * fine), level)
        sigma = self._truth.preset.camera.defocus_px * fine
        blurred = cv2.GaussianBlur(sample, (0, 0), sigma)
        size = (depth.shape[0] * BINNING, depth.shape[1] * BINNING)
        return _resized(blurred, size, cv2.INTER_AREA) * np.float32(1 / 255)

    def _room_on(self, normal: Normal) -> Array:
        """Room light on surfaces with a normal in the camera's frame; 1 from above."""
        up = sum(n * u for n, u in zip(normal, self._up, strict=True))
        rise = np.float32(AMBIENT * (1 - SIDE_LIGHT) / 2)
        return rise * up + np.float32(AMBIENT * (1 + SIDE_LIGHT) / 2)

    def _beam_geometry(
        self, rays: Rays, depth: Array, normal: Normal
    ) -> tuple[Array, Array, Array]:
        """For points at `depth` along rays: how strongly white light falls on them, and the
        projector pixel (u, v) that lights them."""
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
    flat = (len(u), -1)  # of tiles: OpenCV refuses pictures of more than 32767 rows
    columns = (u - np.float32(region.left)).reshape(flat)
    rows = (v - np.float32(region.top)).reshape(flat)
    return cv2.remap(light, columns, rows, cv2.INTER_LINEAR).reshape(u.shape)


def _finer(values: Array, n: int) -> Array:
    """(h n, w n, ...) from (h, w, ...) given at the middles of blocks; linear also at the rim."""
    edge = [(1, 1), (1, 1)] + [(0, 0)] * (values.ndim - 2)
    padded = np.pad(values, edge, mode="reflect", reflect_type="odd")
    fine = cv2.resize(padded, None, fx=n, fy=n, interpolation=cv2.INTER_LINEAR)
    return fine[n:-n, n:-n]


def _inside(full: Region) -> tuple[slice, slice]:
    return slice(0, full.bottom - full.top), slice(0, full.right - full.left)


def _resized(picture: Array, shape: tuple[int, int], how: int = cv2.INTER_LINEAR) -> Array:
    resized: Array = cv2.resize(picture, (shape[1], shape[0]), interpolation=how)
    return resized


def _around(rows: Array, columns: Array) -> Region:
    """The smallest region of a view's pixels that holds tiles."""
    (top, bottom), (left, right) = ((a.min(), a.max() + 1) for a in (rows, columns))
    return Region(int(left), int(top), int(right), int(bottom)).times(TILE)
