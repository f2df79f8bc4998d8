"""The cell as its drivers see it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array
from cellctl.sim import requests as form
from cellctl.sim.grid import describe
from cellctl.sim.motion import Limits
from cellctl.sim.session import OK, Answer, Door, Session, state


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
    return state(world.arm.read(world.now)), b""


async def robot_read_at(session: Session, request: form.RobotReadAt) -> Answer:
    session.uses_robot = True
    world = session.cell.world
    return state(world.arm.read_at(request.at, world.now)), b""


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


async def robot_draw(session: Session, request: form.RobotDraw) -> Answer:
    return _stroke(session, request, session.cell.world.draw)


async def robot_touch(session: Session, request: form.RobotTouch) -> Answer:
    return _stroke(session, request, session.cell.world.touch)


def _stroke(
    session: Session,
    request: form.RobotDraw,
    start: Callable[[Array, Limits, str | None], float],
) -> Answer:
    session.uses_robot = True
    limits = Limits(
        np.full(6, request.joint_speed_rad_s),
        np.full(6, request.joint_acceleration_rad_s2),
        request.speed_m_s,
    )
    ends = start(np.array(request.joints), limits, request.key())
    session.cell.controller = session
    session.cell.pace.changed()
    return {"ends": ends}, b""


async def robot_followed(session: Session, _: form.RobotFollowed) -> Answer:
    session.uses_robot = True
    world = session.cell.world
    t, joints = world.arm.followed(world.now)
    return {"rows": len(t)}, np.column_stack([t, joints]).tobytes()


async def robot_felt(session: Session, _: form.RobotFelt) -> Answer:
    session.uses_robot = True
    world = session.cell.world
    felt = world.arm.felt(world.now)
    return {"felt": state(felt) if felt else None}, b""


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
        return world.arm.settles_at(world.now, request.standstill_s)

    await pace.wait(settles_at, pace.now() + request.timeout_s)
    return state(world.arm.read(world.now)), b""


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
    picture = await cell.render(cell.renderer.picture, held.truth, held.instants, index, held.ink)
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


DOOR: Door = {
    "hello": (form.Hello, hello),
    "wait": (form.Wait, wait),
    "robot.read": (form.RobotRead, robot_read),
    "robot.read_at": (form.RobotReadAt, robot_read_at),
    "robot.check": (form.RobotCheck, robot_check),
    "robot.move": (form.RobotMove, robot_move),
    "robot.draw": (form.RobotDraw, robot_draw),
    "robot.touch": (form.RobotTouch, robot_touch),
    "robot.followed": (form.RobotFollowed, robot_followed),
    "robot.felt": (form.RobotFelt, robot_felt),
    "robot.stop": (form.RobotStop, robot_stop),
    "robot.wait": (form.RobotWait, robot_wait),
    "camera.dequeue": (form.CameraDequeue, camera_dequeue),
    "camera.picture": (form.CameraPicture, camera_picture),
    "projector.show": (form.ProjectorShow, projector_show),
}
