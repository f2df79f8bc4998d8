"""What a section is made of. The template knows how each of them looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from markupsafe import Markup


@dataclass(frozen=True)
class Note:
    """A paragraph; `tone` is plain, good, bad or missing."""

    kind: ClassVar[str] = "note"
    text: str
    tone: str = "plain"


@dataclass(frozen=True)
class Figures:
    """Drawings or pictures side by side: (drawing, caption). `wide`: one to a row. `beside`:
    facts to the right of a single one."""

    kind: ClassVar[str] = "figures"
    items: Sequence[tuple[Markup, str]]
    wide: bool = False
    legend: Sequence[tuple[str, str]] = ()
    beside: Sequence[tuple[str, Any]] = ()


@dataclass(frozen=True)
class Table:
    """`columns` are (heading, is it a figure); `groups` are headings over them, (text, span).
    Rows marked in `strong` are set off."""

    kind: ClassVar[str] = "table"
    columns: Sequence[tuple[str, bool]]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    groups: Sequence[tuple[str, int]] = ()
    strong: Sequence[int] = ()


@dataclass(frozen=True)
class Facts:
    """Names and values."""

    kind: ClassVar[str] = "facts"
    items: Sequence[tuple[str, Any]]
    caption: str = ""


@dataclass(frozen=True)
class Folded:
    """Long text behind a heading; open in print."""

    kind: ClassVar[str] = "folded"
    title: str
    text: str


@dataclass(frozen=True)
class Heading:
    """Of a part of a section."""

    kind: ClassVar[str] = "heading"
    text: str
    aside: str = ""


Block = Note | Figures | Table | Facts | Folded | Heading


@dataclass(frozen=True)
class Section:
    """A chapter of the report."""

    id: str
    title: str
    lead: str = ""
    blocks: Sequence[Block] = field(default_factory=list)
