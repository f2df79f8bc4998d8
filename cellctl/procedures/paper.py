"""Paper: spots to draw on are planned once a run, claimed before the pen comes down, and never
used twice, whatever happens in between."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from cellctl.cell import Cell
from cellctl.errors import SolveError
from cellctl.procedures.pen import PenRig
from cellctl.procedures.spots import PlannedSpot, Sight, plan_spots
from cellctl.run import CANCEL, Run, StepCancelled
from cellctl.store.sheets import Spot

SPOTS = "spots"
SPARES = 0.25
"""Spots planned beyond what is needed, to take the place of void ones."""


async def planned(
    run: Run,
    cell: Cell,
    rig: PenRig,
    count: int,
    radius: float,
    seed: int,
    *,
    turned: bool = True,
    sight: Sight | None = None,
    telling: bool = False,
) -> list[PlannedSpot]:
    """At least `count` spots for circles of `radius` metres, best spread first, then spares; see
    `plan_spots`.

    A run plans once. With too little free paper it asks a person for a fresh sheet. SolveError
    when not even fresh sheets have the room.
    """
    recorded = run.recall(SPOTS)
    if recorded is None:
        plan = partial(
            plan_spots, rig, cell.config, radius=radius, seed=seed, turned=turned, sight=sight
        )
        spots = await _enough(run, cell, partial(plan, telling=telling), count)
        recorded = {"spots": [spot.to_dict() for spot in spots]}
        await run.record(SPOTS, **recorded)
    return [PlannedSpot.from_dict(spot) for spot in recorded["spots"]]


async def _enough(
    run: Run, cell: Cell, plan: Callable[..., list[PlannedSpot]], count: int
) -> list[PlannedSpot]:
    names = [sheet.name for sheet in cell.config.sheets]
    if not names:
        raise SolveError("the config declares no [[sheets]]: nothing may be drawn on the table")
    while True:
        used = [(name, spot) for name in names for spot in cell.sheets.spots(name)]
        wanted = count + int(SPARES * count)
        spots: list[PlannedSpot] = await run.call(partial(plan, used=used, count=wanted))
        if len(spots) >= count:
            return spots
        if not used:
            raise SolveError(
                f"fresh paper has room for only {len(spots)} of {count} circles that the pen can "
                "reach: use fewer or smaller ones, or declare larger [[sheets]]"
            )
        await _fresh_sheet(run, cell, [name for name, _ in used], len(spots), count)


async def _fresh_sheet(run: Run, cell: Cell, used: list[str], free: int, count: int) -> None:
    names = list(dict.fromkeys(used))
    answers = {f"fresh paper lies on {name}": name for name in names}
    answer = await run.ask(
        f"The paper has room for only {free} of {count} circles: lay a fresh sheet on "
        f"{' or '.join(names)}, flat and where the old one lay",
        [*answers, CANCEL],
    )
    if answer == CANCEL:
        raise StepCancelled
    await cell.sheets.fresh(answers[answer])


def owner(run: Run, key: str) -> str:
    """Who claims a spot: the sample `key` of the run's current step."""
    return f"{run.run_id}/{run.address(key)}"


async def claim(run: Run, cell: Cell, key: str, spot: PlannedSpot, radius: float) -> None:
    """The pen is about to come down there, for the sample `key`."""
    x, y = (float(v) for v in spot.xy)
    await cell.sheets.claim(spot.sheet, Spot(x, y, radius, owner(run, key)))


async def settle(run: Run, cell: Cell, key: str, spot: PlannedSpot) -> None:
    """What was claimed for the sample `key` is drawn."""
    await cell.sheets.settle(spot.sheet, owner(run, key))


def cut_short(run: Run, cell: Cell, key: str) -> bool:
    """Whether the pen may have been down for a sample that was never journalled."""
    return key not in run.samples() and cell.sheets.claimed_by(owner(run, key))
