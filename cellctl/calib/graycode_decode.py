"""Gray code read from a camera's pictures: where its edges run, to a fraction of a pixel.

An edge of the code is where a picture and its inverse are equally bright. That place depends
neither on how bright the surface is nor on the gamma of projector or camera, and it is found
between pixels; the coarser bits say which edge it is. What is in shadow, saturated, or lit by
detours more than by the projector is left out: D. Moreno, G. Taubin, Simple, accurate, and robust
projector-camera calibration, 2012, section 3; Y. Xu, D. Aliaga, Robust pixel classification for
3D modeling with structured light, 2007.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cellctl.calib.graycode import BLACK, WHITE, Axis, GrayCode, Slide
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

Grey = NDArray[np.uint8]

LEAST_CONTRAST = 10
"""Grey levels between white and black: less is shadow, or print too dark to be read."""
SATURATED = 252
TOLD = 0.15
"""A bit is told when picture and inverse differ by that part of white and black's contrast:
light that comes by detours, and the blur of finer stripes, take away from it."""
STEEP, FULL = 0.2, 0.3
"""What the same difference, -1 to 1, must change by from pixel to pixel at an edge, and reach on
either side."""
LEAST_LIT = 0.005
"""Part of the picture that must be lit."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Where the camera sees edges of one coordinate's code: `places` (n, 2) in camera pixels,
    and the projector's coordinate (n,) there, in its pixels."""

    places: Array
    values: Array

    def __getitem__(self, index: Mask | Array) -> Edges:
        return Edges(self.places[index], self.values[index])

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, eq=False)
class Decoded:
    """Edges of columns and rows; `lit` (h, w) is where the projector's light was readable,
    `shadow` and `saturated` are the parts of the picture that were not."""

    columns: Edges
    rows: Edges
    lit: Mask
    shadow: float
    saturated: float


def decode(pictures: Sequence[Grey], code: GrayCode) -> Decoded:
    """Read grey pictures (h, w), in the order of `code.slides`.

    Pictures are asked for one or two at a time, so a sequence may load them when they are. A
    SolveError when hardly anything is lit, or white is darker than black.
    """
    white = pictures[code.index(WHITE)].astype(np.float32)
    black = pictures[code.index(BLACK)].astype(np.float32)
    contrast = white - black
    saturated = cv2.dilate((white >= SATURATED).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    bright = contrast >= LEAST_CONTRAST
    _require_light(bright, contrast)
    lit = bright & ~saturated
    scale = np.where(lit, 1.0 / np.maximum(contrast, LEAST_CONTRAST), 0.0).astype(np.float32)
    middle = None if code.inverses else (white + black) / 2.0
    columns, rows = (_edges(pictures, code, axis, lit, scale, middle) for axis in ("column", "row"))
    return Decoded(columns, rows, lit, float(1.0 - bright.mean()), float(saturated.mean()))


def _require_light(bright: Mask, contrast: Array) -> None:
    if float((contrast <= -LEAST_CONTRAST).mean()) > max(float(bright.mean()), LEAST_LIT):
        raise SolveError(
            "the black picture is brighter than the white one: are they swapped, or is the order "
            "of the pictures another one than stated?"
        )
    if float(bright.mean()) < LEAST_LIT:
        raise SolveError(
            f"only {100 * bright.mean():.1f} % of the picture is lit by the projector: is it on, "
            "is the exposure long enough, and are these pictures in the order that is stated?"
        )


def _edges(
    pictures: Sequence[Grey],
    code: GrayCode,
    axis: Axis,
    lit: Mask,
    scale: Array,
    middle: Array | None,
) -> Edges:
    """From the coarsest bit to the finest; `told` is where all bits so far are certain, and
    `prefix` the number that they spell."""
    told, prefix = lit.copy(), np.zeros(lit.shape, np.int32)
    places, values = [], []
    offset = code.offset[0 if axis == "column" else 1]
    for bit in code.bits(axis):
        signed = _signed(pictures, code, axis, bit, scale, middle)
        for across in (True, False):
            where, numbers = _crossings(signed, told, prefix, across=across)
            places.append(where)
            values.append(numbers * 2.0 ** (bit + 1) + 2.0**bit - 0.5 - offset)
        told &= np.abs(signed) > TOLD
        prefix = 2 * prefix + ((prefix & 1) ^ (signed > 0))
    return Edges(np.concatenate(places), np.concatenate(values))


def _signed(
    pictures: Sequence[Grey],
    code: GrayCode,
    axis: Axis,
    bit: int,
    scale: Array,
    middle: Array | None,
) -> Array:
    """(h, w) float32: 1 where a bit is fully lit, -1 where it is fully dark."""
    shown = pictures[code.index(Slide(axis, bit))].astype(np.float32)
    if middle is not None:
        return 2.0 * (shown - middle) * scale
    inverse = pictures[code.index(Slide(axis, bit, inverse=True))]
    return (shown - inverse) * scale


def _crossings(signed: Array, told: Mask, prefix: Array, *, across: bool) -> tuple[Array, Array]:
    """Where `signed` changes its sign along a row of the picture (else down a column), within
    one stripe of the coarser bits: places (n, 2), and the stripe's number (n,).

    Both pixels beyond must agree with their neighbour: stripes that the camera cannot resolve
    have no place of their own.
    """
    if not across:
        signed, told, prefix = signed.T, told.T, prefix.T
    before, a, b, after = (signed[:, i : signed.shape[1] - 3 + i] for i in range(4))
    sound = told[:, 1:-2] & told[:, 2:-1] & (prefix[:, 1:-2] == prefix[:, 2:-1])
    sound &= (a * b < 0) & (np.abs(a - b) > STEEP) & (before * a > 0) & (after * b > 0)
    row, column = np.nonzero(sound)
    before, a, b, after = (side[row, column].astype(float) for side in (before, a, b, after))
    full = np.minimum(np.maximum(abs(before), abs(a)), np.maximum(abs(after), abs(b))) > FULL
    row, column, a, b = row[full], column[full] + 1, a[full], b[full]
    along = column + a / (a - b)
    places = np.column_stack([along, row] if across else [row, along])
    return places.astype(float), prefix[row, column].astype(float)
