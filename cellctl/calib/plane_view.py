"""A plane as a camera sees it: places on it, pixels, and the picture laid flat."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.camera import CameraModel
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, Mask, invert, rigid, transform_points

NODES = 8
"""A flat picture is interpolated between exact places every so many cells: a lens bends the
picture over that length by 0.002 px."""
MOST_CELLS, LONGEST = 6_000_000, 16_000
RIM = 1.05
"""Rays further off the axis than the picture's by that factor have no picture: there a
distortion polynomial may fold back into it."""
STEP_M = 1e-4


class PlaneView:
    """`T_camera_plane` (4, 4): p_camera = T_camera_plane (x, y, 0), metres.

    SolveError when the camera stands in the plane; BadInput when the pose is not rigid.
    """

    def __init__(self, camera: CameraModel, T_camera_plane: ArrayLike) -> None:
        self.camera = camera
        self.pose = rigid(T_camera_plane, "T_camera_plane")
        self._back = invert(self.pose)
        if abs(self._back[2, 3]) < 1e-6:
            raise SolveError("the camera stands in the plane that it should look at")
        self._rim = RIM * _largest_ray(camera)

    def depths(self, places: Array) -> Array:
        """Depth (...) along the optical axis of places (..., 2), metres."""
        return places @ self.pose[2, :2] + self.pose[2, 3]

    def pixels(self, places: Array) -> Array:
        """Pixels (..., 2) of places (..., 2) on the plane; not-a-number where the camera cannot
        see, though a little beyond the picture's edge is still told."""
        points = places @ self.pose[:3, :2].T + self.pose[:3, 3]
        rays = points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        beyond = ~(np.hypot(rays[..., 0], rays[..., 1]) <= self._rim)
        pixels = self.camera.project(points)
        pixels[beyond] = np.nan
        return pixels

    def places(self, pixels: Array) -> Array:
        """Places (..., 2) on the plane seen at pixels (..., 2); not-a-number where the ray does
        not meet it."""
        xy = self.camera.normalise(pixels)
        rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ self._back[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -self._back[2, 3] / rays[..., 2]
            along = np.where(along > 0, along, np.nan)
        return transform_points(self._back, np.zeros(3))[:2] + rays[..., :2] * along[..., None]

    def pixel_m(self, places: Array) -> Array:
        """Metres (...) on the plane that a pixel covers at places (..., 2), the geometric mean
        over directions."""
        x, y = np.array([STEP_M, 0.0]), np.array([0.0, STEP_M])
        across = (self.pixels(places + x) - self.pixels(places - x)) / (2.0 * STEP_M)
        down = (self.pixels(places + y) - self.pixels(places - y)) / (2.0 * STEP_M)
        area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
        return 1.0 / np.sqrt(area)

    def extent(self) -> tuple[Array, Array]:
        """Corners (2,), (2,) of the rectangle on the plane that holds all that the picture shows;
        infinite when the picture reaches beyond the plane's horizon."""
        edge = self.places(_border(self.camera))
        if not np.isfinite(edge).all():
            return np.full(2, -np.inf), np.full(2, np.inf)
        return edge.min(axis=0), edge.max(axis=0)

    def inside(self, pixels: Array, margin: float = 0.0) -> Mask:
        """(...): whether pixels (..., 2) lie in the picture, `margin` px off its edge."""
        size = np.array(self.camera.image_size)
        with np.errstate(invalid="ignore"):
            within = (pixels >= margin) & (pixels <= size - 1 - margin)
        return np.asarray(within.all(axis=-1))


@dataclass(frozen=True, eq=False)
class Flat:
    """A picture laid flat: `values` (h, w) float32 at places origin + (column, row) * cell_m;
    `seen` (h, w) tells where the camera sees them."""

    values: Array
    seen: Mask
    origin: Array
    cell_m: float

    def cells(self, places: Array) -> Array:
        """Columns and rows (..., 2), not rounded, of places (..., 2)."""
        return (places - self.origin) / self.cell_m


def flatten(view: PlaneView, image: Array, low: Array, high: Array, cell_m: float) -> Flat:
    """The part of `image` (h, w) that shows the rectangle from `low` to `high`, (2,) metres on
    the plane. Cells grow where the rectangle would have more than MOST_CELLS of them."""
    least = max(np.sqrt(np.prod(high - low) / MOST_CELLS), (high - low).max() / LONGEST)
    cell_m = max(cell_m, float(least))
    columns, rows = np.ceil((high - low) / cell_m / NODES).astype(int) + 1
    x = low[0] + cell_m * (NODES * np.arange(-1, columns + 1) + (NODES - 1) / 2)
    y = low[1] + cell_m * (NODES * np.arange(-1, rows + 1) + (NODES - 1) / 2)
    nodes = view.pixels(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    size = ((columns + 2) * NODES, (rows + 2) * NODES)
    pixels = cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR)[NODES:-NODES, NODES:-NODES]
    seen = view.inside(pixels)
    pixels = np.where(seen[..., None], pixels, -1.0)
    x_map, y_map = (np.ascontiguousarray(pixels[..., i], dtype=np.float32) for i in (0, 1))
    values = cv2.remap(image, x_map, y_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Flat(np.asarray(values, dtype=np.float32), seen, low.astype(float), cell_m)


def _largest_ray(camera: CameraModel) -> float:
    """Tangent of the largest angle off the optical axis within the picture."""
    rays = camera.normalise(_border(camera))
    known = np.isfinite(rays).all(axis=-1)
    if not known.any():
        raise BadInput("camera: its distortion has no inverse at the picture's edge")
    return float(np.linalg.norm(rays[known], axis=-1).max())


def _border(camera: CameraModel) -> Array:
    """Pixels (n, 2) along the picture's edge."""
    w, h = camera.image_size
    t = np.linspace(0.0, 1.0, 33)
    across = [np.stack([t * (w - 1), np.full_like(t, y)], axis=-1) for y in (0, h - 1)]
    down = [np.stack([np.full_like(t, x), t * (h - 1)], axis=-1) for x in (0, w - 1)]
    return np.concatenate(across + down)
