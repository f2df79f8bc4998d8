"""What is true in the cell: for those who score a run only."""

from __future__ import annotations

import numpy as np

from cellctl.geometry import Array
from cellctl.sim import requests as form
from cellctl.sim.drawn import drawn
from cellctl.sim.session import Answer, Door, Session


async def truth_grid(session: Session, _: form.Nothing) -> Answer:
    return {"points": session.cell.grid.points.tolist()}, b""


async def truth_score(session: Session, request: form.Score) -> Answer:
    cell = session.cell
    return cell.grid.score(np.array(request.pixels), cell.world.truth), b""


async def truth_collisions(session: Session, _: form.Nothing) -> Answer:
    world = session.cell.world
    found = [
        {"t": c.t, "between": list(c.between), "flange_m": list(c.flange_m)}
        for c in world.arm.collisions(world.now)
    ]
    return {"collisions": found}, b""


async def truth_read(session: Session, _: form.Nothing) -> Answer:
    """The cell's true poses and lenses now, and where the flange truly is."""
    world = session.cell.world
    truth = world.truth
    lenses = {
        name: {
            "K": device.lens.matrix.tolist(),
            "distortion": device.lens.distortion.tolist(),
            "image_size": list(device.lens.size),
            f"T_world_{name}": device.pose.to_list(),
        }
        for name, device in (("camera", truth.camera), ("projector", truth.projector))
    }
    boards = {
        name: {f"T_flange_{name}": board.pose.to_list(), "scale": board.scale, "bend_m": board.bend}
        for name, board in truth.boards.items()
    }
    flange: Array = world.arm.frames(np.array([world.now]))[0, -1]
    table = {"T_world_table": truth.table.pose.to_list(), "bow_m": truth.table.bow}
    pen = {"tip_m": truth.pen.tolist()}
    return {
        **lenses,
        "boards": boards,
        "table": table,
        "pen": pen,
        "T_world_flange": flange.tolist(),
    }, b""


async def truth_ink(session: Session, _: form.Nothing) -> Answer:
    """What each stroke has left on the paper that lies there: its circle in the world."""
    world = session.cell.world
    return {"strokes": drawn(world.truth, world.arm.pen.ink(world.now))}, b""


DOOR: Door = {
    "grid": (form.Nothing, truth_grid),
    "score": (form.Score, truth_score),
    "ink": (form.Nothing, truth_ink),
    "collisions": (form.Nothing, truth_collisions),
    "read": (form.Nothing, truth_read),
}
