"""The door of truth, for those who score a run. No procedure may open it."""

from __future__ import annotations

from typing import Any

import numpy as np

from cellctl.geometry import Array
from cellctl.sim.endpoint import Endpoint
from cellctl.sim.link import Link


class Scorer:
    """A client of the truth's door."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._link = Link("truth", endpoint.truth)

    async def grid(self) -> Array:
        """The world points (121, 3), metres, at which a run is scored: 11 x 11 over 110 % of the
        drawn area, at the table's height as the robot knows it."""
        header, _ = await self._link.request("grid")
        return np.array(header["points"])

    async def score(self, pixels: Array) -> dict[str, float]:
        """`true_mm` and `true_px` of the projector pixels (121, 2) sent for the grid's points.

        BadInput when they are not that many or not finite.
        """
        header, _ = await self._link.request("score", pixels=np.asarray(pixels).tolist())
        return {"true_mm": header["true_mm"], "true_px": header["true_px"]}

    async def collisions(self) -> list[dict[str, Any]]:
        """Everything that the arm touched: `t`, `between` two names, `flange_m`."""
        header, _ = await self._link.request("collisions")
        found: list[dict[str, Any]] = header["collisions"]
        return found

    async def ink(self) -> list[dict[str, Any]]:
        """What the strokes have left on the sheets: `stroke` (counted from the world's beginning),
        `sheet`, `length_m`, `centre_m` in the world and `radius_m` of the circle."""
        header, _ = await self._link.request("ink")
        found: list[dict[str, Any]] = header["strokes"]
        return found

    async def read(self) -> dict[str, Any]:
        """The true lenses, poses, boards, table and pen, as they are now."""
        header, _ = await self._link.request("read")
        return {key: value for key, value in header.items() if key not in ("id", "t")}

    async def close(self) -> None:
        await self._link.close()


class FaultPlanter:
    """A client of the door of faults, for tests and exercises."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._link = Link("faults", endpoint.faults)

    async def plant(self, verb: str, **arguments: Any) -> None:
        """One of the verbs of `doors.DOORS["faults"]`."""
        await self._link.request(verb, **arguments)

    async def close(self) -> None:
        await self._link.close()
