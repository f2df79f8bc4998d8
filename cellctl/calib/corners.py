"""What all finders share: grey pictures, interpolation, corners to a few hundredths of a pixel."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cellctl.errors import BadInput
from cellctl.geometry import Array

Grey = NDArray[np.uint8]

REACH = 0.4
"""Half the window of a crossing's refinement, in squares: as large as blur and a tilted
neighbour's edges allow."""
STEPS, SPACING_PX = 8, 1.4
"""The window is sampled that finely; it ends where samples would be further apart than that."""
ITERATIONS, SETTLED_PX = 8, 0.01


def grey(image: Any) -> Grey:
    """A grey uint8 (h, w) picture from a grey or BGR one; BadInput says what is wrong."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise BadInput(f"a picture must be an array of uint8, not {kind}")
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if image.ndim != 2:
        raise BadInput(f"a picture must be (h, w) grey or (h, w, 3) BGR, not {image.shape}")
    if min(image.shape) < 16:
        raise BadInput(f"a picture of {image.shape[1]}x{image.shape[0]} pixels is too small")
    return np.ascontiguousarray(image)


def reduced(image: Grey, longest: int, blur: float) -> tuple[Grey, float]:
    """The picture with its longest side at most `longest` px, softened, and its scale.

    Finders that binarise take seconds on full noise and milliseconds on this.
    """
    scale = min(1.0, longest / max(image.shape))
    small: Any = image
    if scale < 1.0:
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if blur > 0:
        small = cv2.GaussianBlur(small, (0, 0), blur)
    return small, scale


def enlarged(pixels: Array, scale: float) -> Array:
    """Pixels (..., 2) of a reduced picture in the full one; pixel centres at integers."""
    return (pixels + 0.5) / scale - 0.5


def refine_crossings(image: Grey, pixels: Array, axes: Array, reach: float = REACH) -> Array:
    """Sub-pixel crossings (n, 2) of a checkerboard near `pixels` (n, 2).

    `axes` (n, 2, 2) are the sides of a square there, px: [k, 0] along the board's x, [k, 1] along
    its y. The window, |u|, |v| <= `reach` squares, is aligned with the board instead of the
    picture: what is printed further away stays outside at any tilt.

    Every gradient g at p of a crossing's edges is normal to p - q at the crossing q, so q
    solves sum(g g^T) q = sum(g g^T p): Foerstner and Guelch 1987, as cv2.cornerSubPix.
    """
    low = np.maximum(np.floor(pixels.min(axis=0) - np.abs(axes).sum(axis=1).max()) - 3, 0)
    high = np.ceil(pixels.max(axis=0) + np.abs(axes).sum(axis=1).max()) + 4
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    part = image[top:bottom, left:right]
    slopes = cv2.merge([cv2.Scharr(part, cv2.CV_32F, 1, 0), cv2.Scharr(part, cv2.CV_32F, 0, 1)])
    sides = np.linalg.norm(axes, axis=-1).max(axis=-1)
    reaches = np.minimum(reach, STEPS * SPACING_PX / sides)
    steps = np.linspace(-1.0, 1.0, 2 * STEPS + 1)
    window = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) @ axes
    window = window * reaches[:, None, None]
    weights = np.exp(-0.5 * np.square(np.linspace(-1.0, 1.0, 2 * STEPS + 1)))
    weights = np.outer(weights, weights).reshape(-1, 1)
    found = pixels - low
    for _ in range(ITERATIONS):
        g = sample(slopes, found[:, None, :] + window) * weights
        along = (g * window).sum(axis=-1, keepdims=True)
        step = _solve(np.swapaxes(g, 1, 2) @ g, (g * along).sum(axis=1))
        found = found + step
        if np.abs(step).max() < SETTLED_PX:
            break
    return found + low


def _solve(matrices: Array, vectors: Array) -> Array:
    """Solve symmetric (n, 2, 2) x = (n, 2); no step where a picture shows no crossing."""
    a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    determinant = a * d - b * b
    sound = determinant > 1e-6 * np.square(a + d)
    scale = np.where(sound, 1.0 / np.where(sound, determinant, 1.0), 0.0)
    u, v = vectors[:, 0], vectors[:, 1]
    return np.stack([(d * u - b * v) * scale, (a * v - b * u) * scale], axis=-1)


def grid_axes(grid: Array) -> Array:
    """Sides of a square (rows * columns, 2, 2), as `refine_crossings` wants them, at each corner
    of a grid of pixels (rows, columns, 2)."""
    along = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=-2)
    return along.reshape(-1, 2, 2)


def grid_spacing(grid: Array) -> float:
    """Smallest distance between neighbours of a grid of pixels (rows, columns, 2)."""
    across = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    return float(min(across.min(initial=np.inf), down.min(initial=np.inf)))


def cross(a: Array, b: Array) -> Array:
    """a x b (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def sample(image: Array, pixels: Array) -> Array:
    """Bilinear values (...) of a picture (h, w) at pixels (..., 2), or (..., c) of one (h, w, c);
    beyond the edge, those of the edge.

    In floating point: cv2.remap rounds places to 1/32 px, which would bias edges.
    """
    h, w = image.shape[:2]
    x = np.clip(pixels[..., 0], 0.0, w - 1.001)
    y = np.clip(pixels[..., 1], 0.0, h - 1.001)
    column, row = x.astype(np.intp), y.astype(np.intp)
    u, v = (x - column).astype(np.float32), (y - row).astype(np.float32)
    if image.ndim == 3:
        u, v = u[..., None], v[..., None]
    flat, first = image.reshape(h * w, *image.shape[2:]), row * w + column
    top = flat[first] * (1.0 - u) + flat[first + 1] * u
    bottom = flat[first + w] * (1.0 - u) + flat[first + w + 1] * u
    return top * (1.0 - v) + bottom * v


def saddle_strength(image: Grey, sigma: float) -> Array:
    """(h, w): how much each pixel looks like the crossing of a checkerboard, -det of the Hessian
    of the picture softened by `sigma` px; negative elsewhere."""
    soft = cv2.GaussianBlur(image, (0, 0), sigma).astype(np.float32)
    xx = cv2.Sobel(soft, cv2.CV_32F, 2, 0) / 4.0
    yy = cv2.Sobel(soft, cv2.CV_32F, 0, 2) / 4.0
    xy = cv2.Sobel(soft, cv2.CV_32F, 1, 1) / 4.0
    return np.asarray(xy * xy - xx * yy)
