"""What is printed on the boards, as reflectance textures in several resolutions.

Board coordinates are nominal metres (x right, y down, z into the board), as the detectors of
`cellctl.calib.targets` report them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array
from cellctl.sim.presets import BoardPreset

INK, PAPER = 0.05, 0.85
LEVELS = 5
CELL_TEXELS = {"checkerboard": 160, "markers": 40}  # of a square, of a marker's cell


@dataclass(frozen=True, eq=False)
class Texture:
    """A pyramid of (h, w) uint8 reflectances, 255 = 1; each level has half the resolution of the
    one before. `origin` (2,) is the corner of texel (0, 0) on the board,
    `texel` its size at level 0, in metres."""

    levels: tuple[Array, ...]
    origin: Array
    texel: float

    def level_for(self, step: float) -> int:
        """The level whose texels are just not larger than `step`, metres on the board."""
        level = int(np.floor(np.log2(max(step / self.texel, 1.0))))
        return min(level, len(self.levels) - 1)

    def places(self, x: Array, y: Array, level: int) -> tuple[Array, Array]:
        """Texel coordinates (columns, rows) float32 of nominal board coordinates."""
        scale = 1.0 / (self.texel * 2**level)
        columns, rows = (
            a * np.float32(scale) - np.float32(corner * scale + 0.5)
            for a, corner in zip((x, y), self.origin, strict=True)
        )
        return columns, rows

    def sample(self, columns: Array, rows: Array, level: int) -> Array:
        """uint8 at texel coordinates (h, w) each; paper beside the sheet."""
        return cv2.remap(
            self.levels[level], columns, rows, cv2.INTER_LINEAR, borderValue=PAPER * 255.0
        )


def description(name: str, preset: BoardPreset) -> dict[str, object]:
    """The board as a data set or a config describes it."""
    if name == "checkerboard":
        return {
            "type": "chessboard",
            "inner_corners": list(preset.inner_corners),
            "square_m": preset.square_m,
        }
    return {
        "type": "aruco-grid",
        "markers": list(preset.markers),
        "marker_m": preset.marker_m,
        "pitch_m": preset.pitch_m,
        "dictionary": preset.dictionary,
        "first_id": 0,
    }


def border(name: str, preset: BoardPreset) -> float:
    """White margin of the sheet around what `truth.bracket` spans, metres."""
    return preset.square_m / 2 if name == "checkerboard" else 0.0


def texture(name: str, preset: BoardPreset) -> Texture:
    """The printed sheet called `name`: "checkerboard" or "markers"."""
    if name == "checkerboard":
        ink, corner, texel = _checkerboard(preset)
    else:
        ink, corner, texel = _markers(preset)
    margin = _texels(border(name, preset), texel)
    sheet = np.pad(np.where(ink, INK, PAPER), margin, constant_values=PAPER)
    levels = [(sheet * 255.0).round().astype(np.uint8)]
    while len(levels) < LEVELS:
        levels.append(_halved(levels[-1]))
    return Texture(tuple(levels), corner - margin * texel, texel)


def _checkerboard(preset: BoardPreset) -> tuple[Array, Array, float]:
    """Ink (h, w), the place of its corner, the texel: black left-above of the first corner."""
    columns, rows = preset.inner_corners
    squares = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 0
    fine = CELL_TEXELS["checkerboard"]
    corner = np.array([-preset.square_m, -preset.square_m])
    return squares.repeat(fine, 0).repeat(fine, 1), corner, preset.square_m / fine


def _markers(preset: BoardPreset) -> tuple[Array, Array, float]:
    """As `_checkerboard`: markers row-major from the first one's first corner at the origin."""
    columns, rows = preset.markers
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, preset.dictionary))
    modules = dictionary.markerSize + 2  # with the black border
    side = modules * CELL_TEXELS["markers"]
    texel = preset.marker_m / side
    pitch, gap = (_texels(m, texel) for m in (preset.pitch_m, preset.pitch_m - preset.marker_m))
    ink = np.zeros((rows * pitch + gap, columns * pitch + gap), dtype=bool)
    for marker in range(columns * rows):
        top, left = (gap + pitch * i for i in divmod(marker, columns))
        cells = dictionary.generateImageMarker(marker, modules) == 0
        fine = CELL_TEXELS["markers"]
        ink[top : top + side, left : left + side] = cells.repeat(fine, 0).repeat(fine, 1)
    return ink, np.array([-gap, -gap]) * texel, texel


def _texels(length: float, texel: float) -> int:
    count = round(length / texel)
    if abs(count * texel - length) > 1e-6:
        raise BadInput(f"a board's {length} m are not a whole number of {texel:.6f} m texels")
    return count


def _halved(level: Array) -> Array:
    height, width = level.shape
    even = cv2.copyMakeBorder(level, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    size = (even.shape[1] // 2, even.shape[0] // 2)
    return cv2.resize(even, size, interpolation=cv2.INTER_AREA)
