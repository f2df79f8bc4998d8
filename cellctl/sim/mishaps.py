"""What goes wrong with pen and paper, and what a person then does about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cellctl.errors import NotFound
from cellctl.geometry import Array
from cellctl.sim.paper import PRINT_M, Sheet
from cellctl.sim.truth import laid_sheet
from cellctl.sim.world import World


def shift_pen(world: World, shift_m: Array) -> None:
    """The pen sits elsewhere in its holder, (3,) in the flange frame, for good."""
    world.become(replace(world.truth, pen=world.truth.pen + shift_m))


def dry_pen(world: World) -> None:
    """No ink from now on."""
    world.arm.pen.dry = True
    world.arm.look_ahead(world.now)


def fill_pen(world: World) -> None:
    """A person refills the pen."""
    world.arm.pen.dry, world.arm.pen.way_left, world.habits.weak = False, np.inf, 0
    world.arm.look_ahead(world.now)


def weaken_pen(world: World, share: float, count: int) -> None:
    """In the next `count` strokes the ink gives out after `share` of the way."""
    world.habits.share, world.habits.weak = share, count


def shrink_drawing(world: World, factor: float) -> None:
    """Circles come out with `factor` times their radius; 1 is as commanded."""
    world.habits.shrink = factor


def move_sheet(world: World, name: str, shift_m: Array, turn: float) -> None:
    """Somebody shifts a sheet, (2,) along the world's axes, and turns it about its middle."""
    sheet = find_sheet(world, name)
    along_table = world.truth.table.pose.rotation[:2, :2].T @ shift_m
    _lay(world, sheet, sheet.moved(along_table, turn))


def replace_sheet(world: World, name: str | None) -> None:
    """A person lays fresh paper where the cell's config says; None: all sheets."""
    sheets = world.truth.sheets if name is None else (find_sheet(world, name),)
    for sheet in sheets:
        _lay(world, sheet, _fresh(world, sheet))


def print_sheet(world: World, name: str) -> None:
    """A person lays a form with print on it instead."""
    old = find_sheet(world, name)
    form = _fresh(world, old)
    world.arm.pen.print(form, PRINT_M)
    _lay(world, old, form)


def find_sheet(world: World, name: str) -> Sheet:
    """NotFound lists the sheets that there are."""
    for sheet in world.truth.sheets:
        if sheet.name == name:
            return sheet
    known = ", ".join(sheet.name for sheet in world.truth.sheets)
    raise NotFound(f"no sheet {name!r} lies on the table; there are: {known}")


def _fresh(world: World, sheet: Sheet) -> Sheet:
    truth = world.truth
    number = 1 + max(s.number for s in truth.sheets)
    return replace(laid_sheet(truth.preset, truth.table, number), name=sheet.name)


def _lay(world: World, old: Sheet, new: Sheet) -> None:
    sheets = tuple(new if sheet is old else sheet for sheet in world.truth.sheets)
    world.become(replace(world.truth, sheets=sheets))
