"""Randomness that is keyed, not drawn in passing: the same (seed, stream, index) gives the same
numbers in any process, whatever was drawn before."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np

from cellctl.geometry import Array

SLACK = 1 << 22
"""Start positions to choose from in the noise bank. A picture takes two slices, so that two
pictures share both with a probability of 6e-14."""
OFFSET = 6.0
"""What the sensor reads in the dark, grey levels."""


def keyed(seed: int, stream: str, index: str) -> np.random.Generator:
    """A generator for one thing that happens in the world of `seed`."""
    digest = hashlib.sha256(f"{seed}/{stream}/{index}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "big"))


class NoiseBank:
    """Sensor noise of `sigma` grey levels for pictures of `shape` (height, width)."""

    def __init__(self, seed: int, shape: tuple[int, int], sigma: float) -> None:
        self._seed, self._shape = seed, shape
        size = shape[0] * shape[1] + SLACK
        bank = keyed(seed, "sensor-bank", "").standard_normal(size, dtype=np.float32)
        bank *= np.float32(sigma / np.sqrt(2.0))
        bank += np.float32(OFFSET / 2)
        self._bank = bank

    def expose(self, signal: Array, index: str) -> Array:
        """`signal` (h, w) float32 in grey levels as uint8: offset, noise, rounding, saturation."""
        starts = keyed(self._seed, "sensor", index).integers(0, SLACK, 2)
        first, second = (self._slice(start) for start in starts)
        return cv2.add(cv2.add(signal, first), second, dtype=cv2.CV_8U)

    def _slice(self, start: int) -> Array:
        height, width = self._shape
        return self._bank[start : start + height * width].reshape(height, width)
