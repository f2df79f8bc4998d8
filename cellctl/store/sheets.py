"""Which spots of which sheet of paper have ink on them, kept over restarts.

sheets.json   cellctl-sheets/1: {"sheets": {name: {"laid": n, "spots": [...]}}}

A spot is claimed on disk before the pen comes down, and settled when the line is drawn. What is
claimed and never settled was cut short: nobody knows what is on the paper there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cellctl.errors import BadInput
from cellctl.explain import explain
from cellctl.store.files import Schema, read_document, write_document

SHEETS = Schema("cellctl-sheets", 1)
FILE = "sheets.json"

T = TypeVar("T")


@dataclass(frozen=True)
class Spot:
    """Where on a sheet (world x, y, metres) something of `radius_m` was drawn, and for whom:
    `owner` is a run's id and the sample's address in it."""

    x: float
    y: float
    radius_m: float
    owner: str
    state: Literal["claimed", "drawn"] = "claimed"


class _Spot(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    x: float
    y: float
    radius_m: float = Field(ge=0)
    owner: str
    state: Literal["claimed", "drawn"]


class _Sheet(BaseModel):
    model_config = ConfigDict(extra="ignore")
    laid: int = Field(ge=1)
    spots: list[_Spot]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore")
    sheets: dict[str, _Sheet]


class InOrder(Protocol):
    """Runs blocking functions in a thread, one after the other."""

    async def __call__(self, function: Callable[..., T], /, *args: Any) -> T: ...


class SheetLedger:
    """The ledger of one data directory. What a method has written is on disk when it returns.

    Raises BadInput when the file is damaged: without it, spots would be drawn on twice.
    """

    def __init__(self, directory: Path, in_order: InOrder) -> None:
        self._path, self._in_order = directory / FILE, in_order
        self._laid: dict[str, int] = {}
        self._spots: dict[str, list[Spot]] = {}
        if self._path.exists():
            self._read()

    def spots(self, sheet: str) -> list[Spot]:
        """All that is on the sheet of that name, oldest first."""
        return list(self._spots.get(sheet, ()))

    def laid(self, sheet: str) -> int:
        """Which sheet in a row lies there: the first is 1."""
        return self._laid.get(sheet, 1)

    def claimed_by(self, owner: str) -> bool:
        """Whether the pen may have been down for `owner`."""
        return any(s.owner == owner for spots in self._spots.values() for s in spots)

    async def claim(self, sheet: str, spot: Spot) -> None:
        """Before the pen comes down. ValueError when `spot.owner` has a spot already."""
        if self.claimed_by(spot.owner):
            raise ValueError(f"{spot.owner}: a spot is claimed once")
        await self._change(sheet, [*self.spots(sheet), spot])

    async def settle(self, sheet: str, owner: str) -> None:
        """The line of `owner` is drawn to its end. Settling twice does no harm."""
        spots = [replace(s, state="drawn") if s.owner == owner else s for s in self.spots(sheet)]
        await self._change(sheet, spots)

    async def fresh(self, sheet: str) -> None:
        """A person has laid a new sheet: nothing is on it."""
        self._laid[sheet] = self.laid(sheet) + 1
        await self._change(sheet, [])

    async def _change(self, sheet: str, spots: list[Spot]) -> None:
        self._laid.setdefault(sheet, 1)
        self._spots[sheet] = spots
        sheets = {
            name: {"laid": self._laid[name], "spots": [asdict(spot) for spot in spots]}
            for name, spots in self._spots.items()
        }
        await self._in_order(write_document, self._path, SHEETS, {"sheets": sheets})

    def _read(self) -> None:
        try:
            document = _Document.model_validate(read_document(self._path, SHEETS))
        except ValidationError as error:
            raise BadInput(
                f"{self._path}: {explain(error, _Document)}. Restore it; or, when fresh paper lies "
                "on the table, remove it"
            ) from None
        for name, sheet in document.sheets.items():
            self._laid[name] = sheet.laid
            self._spots[name] = [Spot(**spot.model_dump()) for spot in sheet.spots]
