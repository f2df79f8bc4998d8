"""Gray-code pictures for a projector: each of its pixels flashes its own column and row.

Bit k of a coordinate is k-th least significant bit of its Gray code, i ^ (i >> 1): stripes of
2^(k+1) pixels, and at every edge between two coordinates exactly one bit flips. Pixel centres are
at integers, so the edge between pixels i and i + 1 is at i + 1/2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cellctl.errors import BadInput
from cellctl.geometry import Array

Axis = Literal["column", "row"]
AXES: tuple[Axis, Axis] = ("column", "row")
SECTIONS = ("columns", "rows", "white", "black")
LARGEST_SIDE = 32768
KEYS = ("order", "column_bits", "row_bits", "first_bit", "inverses", "offset")


@dataclass(frozen=True)
class Slide:
    """One picture: `bit` of a coordinate, or of its inverse; or all white or black."""

    shows: Literal["column", "row", "white", "black"]
    bit: int = 0
    inverse: bool = False


WHITE, BLACK = Slide("white"), Slide("black")


@dataclass(frozen=True)
class GrayCode:
    """A sequence of `slides` for a projector of `size` (w, h). The pixel (x, y) shows the code
    of (x, y) + `offset`."""

    size: tuple[int, int]
    slides: tuple[Slide, ...]
    offset: tuple[int, int] = (0, 0)

    @classmethod
    def of(
        cls,
        size: tuple[int, int],
        *,
        order: tuple[str, ...] = SECTIONS,
        column_bits: int | None = None,
        row_bits: int | None = None,
        lsb_first: bool = False,
        inverses: bool = True,
        offset: tuple[int, int] = (0, 0),
    ) -> GrayCode:
        """The sections in `order`. The defaults are those of OpenCV's
        structured_light.GrayCodePattern with its white and black picture at the end.

        With fewer bits than a side needs the finest are left out. BadInput when the order lacks
        a section or a side cannot be coded so.
        """
        if sorted(order) != sorted(SECTIONS):
            raise BadInput(f"the order must name each of {', '.join(SECTIONS)} once, not {order}")
        counts = {"columns": column_bits, "rows": row_bits}
        slides: list[Slide] = []
        for section in order:
            if section in ("white", "black"):
                slides.append(WHITE if section == "white" else BLACK)
                continue
            axis = AXES.index(section[:-1])
            bits = _bits(size[axis] + offset[axis], counts[section], section)
            for bit in reversed(bits) if lsb_first else bits:
                slides.append(Slide(AXES[axis], bit))
                slides += [Slide(AXES[axis], bit, inverse=True)] if inverses else []
        return cls(size, tuple(slides), offset)

    def bits(self, axis: Axis) -> list[int]:
        """The bits that are shown of a coordinate, coarsest first."""
        return sorted({s.bit for s in self.slides if s.shows == axis}, reverse=True)

    @property
    def inverses(self) -> bool:
        """Whether each bit is shown a second time, inverted."""
        return any(slide.inverse for slide in self.slides)

    def index(self, slide: Slide) -> int:
        """The place of a slide in the sequence."""
        return self.slides.index(slide)

    def picture(self, slide: Slide) -> NDArray[np.uint8]:
        """What the projector shows, (h, w)."""
        width, height = self.size
        if slide in (WHITE, BLACK):
            return np.full((height, width), 255 if slide == WHITE else 0, np.uint8)
        axis = AXES.index(slide.shows)
        coordinate = np.arange(self.size[axis]) + self.offset[axis]
        lit = (gray(coordinate) >> slide.bit & 1) != slide.inverse
        line = np.where(lit, 255, 0).astype(np.uint8)
        return np.ascontiguousarray(
            np.broadcast_to(line if axis == 0 else line[:, None], (height, width))
        )


def gray(numbers: Array) -> Array:
    """The reflected binary code of whole numbers: F. Gray, US patent 2632058, 1953."""
    return numbers ^ (numbers >> 1)


def _bits(length: int, count: int | None, section: str) -> range:
    """The bits that tell `length` numbers apart, coarsest first, or the coarsest `count` of
    them."""
    needed = max(int(length - 1).bit_length(), 1)
    count = needed if count is None else count
    if not 1 <= count <= needed:
        raise BadInput(
            f"{count} bits for the {section}: {length} of them take {needed}, and at least 1"
        )
    return range(needed - 1, needed - 1 - count, -1)


def code_from(value: Any, size: tuple[int, int], where: str) -> GrayCode:
    """The sequence that a data set describes; BadInput says `where` and what is not understood.

    None is OpenCV's order. An object has some of KEYS: `order` (of SECTIONS), `column_bits` and
    `row_bits`, `first_bit` "msb" or "lsb", `inverses`, `offset` [x, y]. A text is read for the
    same, as in "column bits MSB first, each followed by its inverse, then row bits, then white,
    black"; "no inverse" where there is none.
    """
    if isinstance(value, str):
        value = _described(value, where)
    if value is None:
        value = {}
    if not isinstance(value, Mapping):
        raise BadInput(f"{where}: must be a description or an object, not {value!r}")
    if unknown := set(value) - set(KEYS):
        raise BadInput(f"{where}: unknown key {min(map(str, unknown))!r}; known: {', '.join(KEYS)}")
    try:
        return GrayCode.of(
            size,
            order=_order(value.get("order", SECTIONS)),
            column_bits=_count(value, "column_bits"),
            row_bits=_count(value, "row_bits"),
            lsb_first=_choice(value, "first_bit", "msb", {"msb": False, "lsb": True}),
            inverses=_choice(value, "inverses", True, {True: True, False: False}),
            offset=_offset(value.get("offset", (0, 0))),
        )
    except BadInput as error:
        raise BadInput(f"{where}: {error.message}") from None


def _described(text: str, where: str) -> dict[str, Any]:
    """What a text says of the order of the pictures."""
    words = re.findall(r"[a-z]+", text.lower().split(":")[-1])
    places = {
        section: words.index(word)
        for section, word in zip(SECTIONS, ("column", "row", "white", "black"), strict=True)
        if word in words
    }
    if len(places) < len(SECTIONS) or {"msb", "lsb"} <= set(words):
        raise BadInput(
            f"{where}: cannot tell the order of the pictures from {text!r}; write it like 'column "
            "bits MSB first, each followed by its inverse, then row bits, then white, black', or "
            f"as an object with {', '.join(KEYS)}"
        )
    return {
        "order": sorted(places, key=places.__getitem__),
        "first_bit": "lsb" if "lsb" in words else "msb",
        "inverses": any(word.startswith("inver") for word in words) and "no" not in words,
    }


def _order(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
        raise BadInput(f"order must be a list of {', '.join(SECTIONS)}, not {value!r}")
    return tuple(value)


def _count(value: Mapping[str, Any], key: str) -> int | None:
    count = value.get(key)
    if count is not None and (isinstance(count, bool) or not isinstance(count, int)):
        raise BadInput(f"{key} must be a whole number, not {count!r}")
    return count


def _choice(value: Mapping[str, Any], key: str, default: Any, known: dict[Any, bool]) -> bool:
    given = value.get(key, default)
    match = [meaning for name, meaning in known.items() if name is given or name == given]
    if len(match) != 1 or type(given) is not type(default):
        raise BadInput(f"{key} must be one of {', '.join(map(repr, known))}, not {given!r}")
    return match[0]


def _offset(value: Any) -> tuple[int, int]:
    whole = isinstance(value, list | tuple) and all(type(item) is int for item in value)
    if not whole or len(value) != 2 or min(value) < 0 or max(value) > LARGEST_SIDE:
        raise BadInput(f"offset must be [x, y] in pixels, not {value!r}")
    return value[0], value[1]
