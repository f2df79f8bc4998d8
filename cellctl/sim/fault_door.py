"""Faults that tests plant, and what a person does in a cell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.errors import DeviceFault
from cellctl.sim import mishaps, pendant
from cellctl.sim import requests as form
from cellctl.sim.motion import RING_S
from cellctl.sim.session import OK, Answer, Door, Session
from cellctl.sim.world import World

PATIENCE_S = 300.0


async def nudge(session: Session, request: form.Nudge) -> Answer:
    shift, turn = np.array(request.shift_mm) * 1e-3, np.radians(request.turn_deg)
    session.cell.world.nudge(request.device, shift, turn)
    return OK


async def protective_stop(session: Session, request: form.ProtectiveStop) -> Answer:
    cell = session.cell
    cell.world.arm.protective_stop(cell.world.now, request.reason)
    cell.pace.changed()
    return OK


async def clear_fault(session: Session, _: form.Nothing) -> Answer:
    world = session.cell.world
    world.arm.clear_fault(world.now)
    return OK


async def freeze(session: Session, request: form.Freeze) -> Answer:
    world = session.cell.world
    world.stream.hang(world.now, request.seconds)
    return OK


async def drop(session: Session, request: form.Drop) -> Answer:
    session.cell.world.stream.lose(request.frames)
    return OK


async def lamp_on(session: Session, _: form.Nothing) -> Answer:
    world = session.cell.world
    world.glass.switch(world.now, on=True)
    return OK


async def lamp_off(session: Session, _: form.Nothing) -> Answer:
    world = session.cell.world
    world.glass.switch(world.now, on=False)
    return OK


async def drop_link(session: Session, _: form.Nothing) -> Answer:
    session.cell.drop_robot_links()
    return OK


async def slow(session: Session, request: form.Slow) -> Answer:
    session.cell.slowness.seconds = request.seconds
    session.cell.slowness.count = request.count
    return OK


async def pen_slip(session: Session, request: form.PenSlip) -> Answer:
    shift = 1e-3 * np.array(request.shift_mm)
    return _later(session, request, lambda world: mishaps.shift_pen(world, shift))


async def pen_off(session: Session, request: form.PenOff) -> Answer:
    mishaps.shift_pen(session.cell.world, 1e-3 * np.array(request.shift_mm))
    return OK


async def pen_dry(session: Session, request: form.PenDry) -> Answer:
    return _later(session, request, mishaps.dry_pen)


async def pen_ink(session: Session, _: form.Nothing) -> Answer:
    mishaps.fill_pen(session.cell.world)
    return OK


async def pen_weak(session: Session, request: form.PenWeak) -> Answer:
    share, count = request.share, request.count
    return _later(session, request, lambda world: mishaps.weaken_pen(world, share, count))


async def drawing_shrink(session: Session, request: form.Shrink) -> Answer:
    return _later(session, request, lambda w: mishaps.shrink_drawing(w, request.factor))


async def sheet_move(session: Session, request: form.SheetMove) -> Answer:
    mishaps.find_sheet(session.cell.world, request.sheet)
    shift, turn = 1e-3 * np.array(request.shift_mm), float(np.radians(request.turn_deg))
    return _later(session, request, lambda w: mishaps.move_sheet(w, request.sheet, shift, turn))


async def sheet_replace(session: Session, request: form.SheetReplace) -> Answer:
    if request.sheet is not None:
        mishaps.find_sheet(session.cell.world, request.sheet)
    return _later(session, request, lambda w: mishaps.replace_sheet(w, request.sheet))


async def sheet_print(session: Session, request: form.SheetPrint) -> Answer:
    mishaps.find_sheet(session.cell.world, request.sheet)
    return _later(session, request, lambda w: mishaps.print_sheet(w, request.sheet))


async def pendant_jog(session: Session, request: form.PendantJog) -> Answer:
    pendant.jog(session.cell.world, np.array(request.joints))
    return await _at_rest(session)


async def pendant_place(session: Session, request: form.PendantPlace) -> Answer:
    rotation = Rotation.from_euler("xyz", request.rpy_deg, degrees=True).as_matrix()
    pendant.place(session.cell.world, np.array(request.point), rotation)
    return await _at_rest(session)


def _later(session: Session, request: form.Later, change: Callable[[World], None]) -> Answer:
    world = session.cell.world
    world.after_strokes(request.after_strokes, lambda: change(world))
    session.cell.pace.changed()
    return OK


async def _at_rest(session: Session) -> Answer:
    """Wait until the arm stands and rings no more; DeviceFault when it did not get there."""
    cell = session.cell
    cell.pace.changed()
    arm = cell.world.arm
    await cell.pace.wait(lambda: arm.moving_until() + RING_S, cell.pace.now() + PATIENCE_S)
    if fault := arm.fault(cell.pace.now()):
        raise DeviceFault(f"the arm did not get there: {fault}")
    return OK


DOOR: Door = {
    "nudge": (form.Nudge, nudge),
    "robot.protective_stop": (form.ProtectiveStop, protective_stop),
    "robot.clear_fault": (form.Nothing, clear_fault),
    "robot.drop_link": (form.Nothing, drop_link),
    "camera.freeze": (form.Freeze, freeze),
    "camera.drop": (form.Drop, drop),
    "projector.off": (form.Nothing, lamp_off),
    "projector.on": (form.Nothing, lamp_on),
    "pen.slip": (form.PenSlip, pen_slip),
    "pen.off": (form.PenOff, pen_off),
    "pen.dry": (form.PenDry, pen_dry),
    "pen.ink": (form.Nothing, pen_ink),
    "pen.weak": (form.PenWeak, pen_weak),
    "drawing.shrink": (form.Shrink, drawing_shrink),
    "sheet.move": (form.SheetMove, sheet_move),
    "sheet.replace": (form.SheetReplace, sheet_replace),
    "sheet.print": (form.SheetPrint, sheet_print),
    "pendant.jog": (form.PendantJog, pendant_jog),
    "pendant.place": (form.PendantPlace, pendant_place),
    "slow": (form.Slow, slow),
}
