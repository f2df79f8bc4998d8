"""Rectangles of pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cellctl.geometry import Mask


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels; empty when nothing is in it."""

    left: int
    top: int
    right: int
    bottom: int

    def __bool__(self) -> bool:
        return self.left < self.right and self.top < self.bottom

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def meets(self, other: Region) -> bool:
        """Whether a pixel is in both."""
        return max(self.left, other.left) < min(self.right, other.right) and max(
            self.top, other.top
        ) < min(self.bottom, other.bottom)

    def times(self, n: int) -> Region:
        """The same region in pixels of an n-th of the size."""
        return Region(self.left * n, self.top * n, self.right * n, self.bottom * n)

    def moved(self, right: int, down: int) -> Region:
        return Region(self.left + right, self.top + down, self.right + right, self.bottom + down)

    def cropped(self, shape: tuple[int, ...]) -> Region:
        """What of it lies inside a picture of `shape`."""
        return self.grown(0, shape)

    def grown(self, margin: int, shape: tuple[int, ...]) -> Region:
        """With `margin` pixels around, inside a picture of `shape`."""
        return Region(
            max(self.left - margin, 0),
            max(self.top - margin, 0),
            min(self.right + margin, shape[1]),
            min(self.bottom + margin, shape[0]),
        )


NOWHERE = Region(0, 0, 0, 0)


def bounding(mask: Mask) -> Region:
    """The smallest region that holds all of `mask` (h, w)."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return Region(left, top, left + width, top + height)
