"""What each door of the simulated cell answers.

`cell` is the cell as its drivers see it, `truth` is for scoring only, `faults` plants faults in
tests. A door is a table: verb -> the request's form, the function that answers it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import ValidationError

from cellctl.errors import BadInput, NotFound
from cellctl.explain import explain
from cellctl.geometry import Array
from cellctl.sim import requests as form
from cellctl.sim.grid import Grid, describe
from cellctl.sim.motion import TICK_S, Limits
from cellctl.sim.optics import Renderer
from cellctl.sim.pace import Pace
from cellctl.sim.robot import Reading
from cellctl.sim.world import Exposure, World

Answer = tuple[dict[str, Any], bytes]
Handler = Callable[["Session", Any], Awaitable[Answer]]
Form = type[form.Request]
OK: Answer = ({}, b"")


@dataclass(eq=False)
class Slowness:
    """The next `count` replies come `seconds` late."""

    seconds: float = 0.0
    count: int = 0


@dataclass(eq=False)
class Cell:
    """What all sessions of all doors share. `render` runs a function in the render thread."""

    world: World
    pace: Pace
    renderer: Renderer
    render: Callable[..., Awaitable[Any]]
    drop_robot_links: Callable[[], None]
    slowness: Slowness = field(default_factory=Slowness)
    controller: Session | None = None
    """Whose connection moves the arm."""

    def __post_init__(self) -> None:
        self.grid = Grid(self.world.truth)


@dataclass(eq=False)
class Session:
    """One connection: what it sent last, what it has dequeued but not fetched."""

    cell: Cell
    blob: bytes = b""
    held: Exposure | None = None
    uses_robot: bool = False


async def answer(door: str, session: Session, header: dict[str, Any], blob: bytes) -> Answer:
    """Check a request and carry it out. BadInput names what is wrong with it."""
    verbs = DOORS[door]
    verb = header.get("verb")
    if not isinstance(verb, str) or verb not in verbs:
        raise NotFound(f"door {door!r} knows no verb {verb!r}; known: {', '.join(sorted(verbs))}")
    kind, handler = verbs[verb]
    try:
        request = kind.model_validate(header)
    except ValidationError as error:
        raise BadInput(f"{verb}: {explain(error, kind, most=5)}") from None
    session.blob = blob
    session.cell.pace.now()
    return await handler(session, request)


async def hello(session: Session, _: form.Hello) -> Answer:
    cell = session.cell
    truth = cell.world.truth
    return {**describe(truth.preset), "seed": truth.seed, "time": cell.pace.name}, b""


async def wait(session: Session, request: form.Wait) -> Answer:
    pace = session.cell.pace
    until = pace.now() + request.seconds
    await pace.wait(lambda: until, until)
    return OK


async def robot_read(session: Session, _: form.RobotRead) -> Answer:
    session.uses_robot = True
    world = session.cell.world
    return _state(world.arm.read(world.now)), b""


async def robot_read_at(session: Session, request: form.RobotReadAt) -> Answer:
    session.uses_robot = True
    world = session.cell.world
    return _state(world.arm.read_at(request.at, world.now)), b""


async def robot_check(session: Session, request: form.RobotCheck) -> Answer:
    session.uses_robot = True
    session.cell.world.arm.check(np.array(request.waypoints))
    return OK


async def robot_move(session: Session, request: form.RobotMove) -> Answer:
    session.uses_robot = True
    limits = Limits(
        np.full(6, request.joint_speed_rad_s),
        np.full(6, request.joint_acceleration_rad_s2),
        request.tool_speed_m_s,
    )
    cell = session.cell
    ends = cell.world.move(np.array(request.waypoints), limits, request.key())
    cell.controller = session
    cell.pace.changed()
    return {"ends": ends}, b""


async def robot_stop(session: Session, request: form.RobotStop) -> Answer:
    session.uses_robot = True
    cell = session.cell
    cell.world.arm.stop(cell.world.now, hard=request.hard)
    cell.pace.changed()
    return OK


async def robot_wait(session: Session, request: form.RobotWait) -> Answer:
    session.uses_robot = True
    world, pace = session.cell.world, session.cell.pace

    def settles_at() -> float:
        settled = world.arm.read(world.now).standstill_s >= request.standstill_s
        return max(world.arm.moving_until(), world.now + (0.0 if settled else TICK_S))

    await pace.wait(settles_at, pace.now() + request.timeout_s)
    return _state(world.arm.read(world.now)), b""


async def camera_dequeue(session: Session, request: form.CameraDequeue) -> Answer:
    world, pace = session.cell.world, session.cell.pace
    await pace.wait(world.stream.ready_at, pace.now() + request.timeout_s)
    session.held = world.dequeue()
    if session.held is None:
        return {"frame": None}, b""
    capture = session.held.capture
    frame = {
        "sequence": capture.sequence,
        "t": capture.t,
        "exposure_s": session.held.exposure_s,
    }
    return {"frame": frame}, b""


async def camera_picture(session: Session, request: form.CameraPicture) -> Answer:
    held, cell = session.held, session.cell
    if held is None:
        raise BadInput("camera.picture: no frame was dequeued on this connection")
    index = cell.world.noise_index(held, request.key())
    picture = await cell.render(cell.renderer.picture, held.truth, held.instants, index)
    return {"shape": list(picture.shape)}, picture.tobytes()


async def projector_show(session: Session, request: form.ProjectorShow) -> Answer:
    world = session.cell.world
    width, height = world.truth.preset.projector.size_px
    if request.shape[:2] != (height, width):
        raise BadInput(
            f"projector.show: the image is {request.shape[1]} x {request.shape[0]} pixels, "
            f"the projector {width} x {height}"
        )
    if len(session.blob) != np.prod(request.shape):
        raise BadInput(
            f"projector.show: {len(session.blob)} bytes are no uint8 image of {request.shape}"
        )
    image = np.frombuffer(session.blob, dtype=np.uint8).reshape(request.shape)
    return {"shown": world.show(image, request.key())}, b""


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


def _state(reading: Reading) -> dict[str, Any]:
    return {
        "at": reading.t,
        "joints": reading.joints.tolist(),
        "speeds": reading.speeds.tolist(),
        "T_world_flange": reading.flange.tolist(),
        "standstill_s": reading.standstill_s,
        "fault": reading.fault,
    }


DOORS: dict[str, dict[str, tuple[Form, Handler]]] = {
    "cell": {
        "hello": (form.Hello, hello),
        "wait": (form.Wait, wait),
        "robot.read": (form.RobotRead, robot_read),
        "robot.read_at": (form.RobotReadAt, robot_read_at),
        "robot.check": (form.RobotCheck, robot_check),
        "robot.move": (form.RobotMove, robot_move),
        "robot.stop": (form.RobotStop, robot_stop),
        "robot.wait": (form.RobotWait, robot_wait),
        "camera.dequeue": (form.CameraDequeue, camera_dequeue),
        "camera.picture": (form.CameraPicture, camera_picture),
        "projector.show": (form.ProjectorShow, projector_show),
    },
    "truth": {
        "grid": (form.Nothing, truth_grid),
        "score": (form.Score, truth_score),
        "collisions": (form.Nothing, truth_collisions),
        "read": (form.Nothing, truth_read),
    },
    "faults": {
        "nudge": (form.Nudge, nudge),
        "robot.protective_stop": (form.ProtectiveStop, protective_stop),
        "robot.clear_fault": (form.Nothing, clear_fault),
        "robot.drop_link": (form.Nothing, drop_link),
        "camera.freeze": (form.Freeze, freeze),
        "camera.drop": (form.Drop, drop),
        "projector.off": (form.Nothing, lamp_off),
        "projector.on": (form.Nothing, lamp_on),
        "slow": (form.Slow, slow),
    },
}
