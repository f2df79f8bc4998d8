"""The composition root: config -> devices -> cell -> engine -> bus, and down again.

Nothing moves because the daemon starts. SIGTERM and SIGINT stop the arm, end the active run as
interrupted and leave the bus; a second signal does not hurry it.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import structlog

from cellctl.bus.server import Server
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.drivers.base import Camera, Frame, Identity, Projector, Robot
from cellctl.engine import Engine
from cellctl.gate import Gate
from cellctl.guarded_robot import GuardedRobot
from cellctl.messages import RobotSnapshot
from cellctl.motion import guard_of
from cellctl.permission import Permission
from cellctl.procedures import PROCEDURES
from cellctl.promotion import by_hand, not_worse
from cellctl.report import ReportWriter
from cellctl.sim.drivers import SimCamera, SimProjector, SimRobot
from cellctl.sim.launch import connect_or_start
from cellctl.sim.link import SimClock
from cellctl.store import Store
from cellctl.store.sheets import SheetLedger
from cellctl.worker.child import Child

PRELOAD = ("cellctl.procedures", "cellctl.calib.patterns")

log = structlog.get_logger(__name__)


def serve_forever(config: CellConfig) -> int:
    """Run the daemon until SIGTERM or SIGINT; 0 after a clean end."""
    return asyncio.run(_until_signalled(config))


async def _until_signalled(config: CellConfig) -> int:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    async with serve(config):
        await stop.wait()
        log.info("stopping", cell=config.cell.id)
    return 0


@contextlib.asynccontextmanager
async def serve(config: CellConfig) -> AsyncIterator[Engine]:
    """A running daemon, whole when the block is entered. Ends in the opposite order.

    Raises BadInput (endpoint taken, config that cannot be used), Busy (data directory in use),
    DeviceFault (a device does not answer).
    """
    directory = config.data_dir()
    gate = Gate(Permission(directory, always=config.cell.motion_enabled))
    async with contextlib.AsyncExitStack() as stack:
        store = await Store.open(directory)
        stack.push_async_callback(store.close)
        solver = await stack.enter_async_context(Child("solver", preload=PRELOAD))
        devices = await _open_devices(config, directory, stack)
        await solver.start()
        camera = Watched(devices.camera)
        guard = guard_of(config)
        cell = Cell(
            config=config,
            guard=guard,
            robot=GuardedRobot(devices.robot, guard, config, gate.require),
            camera=camera,
            projector=devices.projector,
            solver=solver,
            sheets=await store.in_order(SheetLedger, directory, store.in_order),
        )
        reports = ReportWriter()
        stack.push_async_callback(reports.close)
        policy = not_worse if config.promotion.policy == "not-worse" else by_hand
        engine = Engine(
            cell,
            list(PROCEDURES.values()),
            store,
            gate,
            promotes=policy,
            report=reports.ask,
        )
        server = Server(
            engine, config.bus.listen, config.cell.id, engine.boot, robot=lambda: snapshot(cell)
        )
        camera.watcher = server
        await stack.enter_async_context(server)
        stack.push_async_callback(engine.shutdown)
        log.info("ready", cell=config.cell.id, boot=engine.boot, data=str(directory))
        yield engine


@dataclass(frozen=True)
class Devices:
    """What a config names, not yet guarded."""

    robot: Robot
    camera: Camera
    projector: Projector


async def _open_devices(
    config: CellConfig, directory: Path, stack: contextlib.AsyncExitStack
) -> Devices:
    """The devices, closed again when `stack` is. Only the simulated ones exist so far; their
    world is found running or started, and outlives the daemon."""
    assert config.simulation is not None  # the config knows no other drivers
    endpoint = await asyncio.to_thread(connect_or_start, config.simulation, directory)
    clock = SimClock(endpoint.time)
    robot = SimRobot(endpoint, config, clock)
    camera = SimCamera(endpoint, config, clock)
    projector = SimProjector(endpoint, config, clock)
    for device in (robot, camera, projector):
        stack.push_async_callback(device.close)
    return Devices(robot, camera, projector)


async def snapshot(cell: Cell) -> RobotSnapshot:
    """What watchers see of the arm."""
    state = await cell.robot.read()
    return RobotSnapshot(
        t=state.t,
        joints=state.joints.tolist(),
        position=state.T_world_flange.translation.tolist(),
        rvec=state.T_world_flange.rvec.tolist(),
        standstill_s=state.standstill_s,
    )


class Watched:
    """A Camera whose pictures are also offered to whoever watches the bus."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.watcher: Server | None = None

    async def identity(self) -> Identity:
        return await self._camera.identity()

    async def grab(self, *, exposed_after: float) -> Frame:
        frame = await self._camera.grab(exposed_after=exposed_after)
        if self.watcher is not None:
            self.watcher.publish_frame("camera", frame.image)
        return frame
