"""A small cell and small procedures: devices that do what they say, on a bench without physics.

The robot moves its joints at a set speed, the camera takes a picture whose noise is keyed by the
sample's name, as the simulated cell does. Each can be told to fail the way a real one does.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import time
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.arms import arm
from cellctl.cell import Cell, Solver
from cellctl.config import parse_config
from cellctl.drivers.base import (
    SAMPLE,
    Frame,
    Identity,
    Image,
    RobotState,
    Stroke,
    StrokeResult,
    Target,
)
from cellctl.drivers.base import Path as Joints
from cellctl.engine import Engine
from cellctl.engine.active_run import Limits
from cellctl.engine.bulletin import Published
from cellctl.errors import BadInput, DeviceFault, MotionRefused, NotEnabled
from cellctl.gate import Gate
from cellctl.geometry import Transform
from cellctl.messages import (
    Accepted,
    AckRequest,
    CancelRequest,
    ResumeRequest,
    RunAccepted,
    RunInfo,
    RunRequest,
    State,
)
from cellctl.motion import guard_of
from cellctl.permission import Permission
from cellctl.run import Procedure, Result, Run
from cellctl.store import Store
from cellctl.store.journal import Entry, read
from cellctl.store.sheets import SheetLedger
from cellctl.worker.child import Child
from tests import cells
from tests.core import functions

SPEED_RAD_S = 20.0
PERIOD_S = 0.005
ARM = arm("ur5")
LIMITS = Limits(stop_s=0.5, unwind_s=0.3, identity_s=0.3)


class ToyRobot:
    """Asks `allowed` before it moves, as the guarded robot does."""

    def __init__(self) -> None:
        self.allowed: Callable[[], None] = lambda: None
        self.joints = np.zeros(6)
        self.moving = False
        self.moves = 0
        self.stops: list[bool] = []
        self.serial = "R-1"
        self.link_lost = False
        self.stop_hangs = False
        self.stop_fails = False

    async def identity(self) -> Identity:
        if self.link_lost:
            await asyncio.sleep(60)
        return Identity("toy", "bench arm", self.serial)

    async def read(self) -> RobotState:
        pose = Transform("world", "flange", ARM.forward(self.joints))
        still = 0.0 if self.moving else 1.0
        return RobotState(time.monotonic(), self.joints.copy(), np.zeros(6), pose, still)

    async def state_at(self, t: float) -> RobotState:
        return await self.read()

    async def check(self, path: Joints) -> None:
        if np.abs(path.waypoints).max() > np.pi:
            raise MotionRefused("a joint would leave its range")

    async def move(self, target: Target, *, timeout_s: float) -> RobotState:
        self.allowed()
        await self.check(target.path)
        self.moving = True
        self.moves += 1
        try:
            for waypoint in target.path.waypoints:
                await self._travel(waypoint, target.speed)
        finally:
            self.moving = False
        return await self.read()

    async def _travel(self, waypoint: np.ndarray, speed: float) -> None:
        while (way := waypoint - self.joints).any():
            if self.link_lost:
                raise DeviceFault("the robot's link was lost")
            await asyncio.sleep(PERIOD_S)
            step = SPEED_RAD_S * speed * PERIOD_S
            self.joints += np.clip(way, -step, step)

    async def draw(self, stroke: Stroke, *, timeout_s: float) -> StrokeResult:
        state = await self.move(Target(Joints(stroke.joints)), timeout_s=timeout_s)
        return StrokeResult(np.full(len(stroke.joints), state.t), stroke.joints, state)

    async def touch(self, stroke: Stroke, *, timeout_s: float) -> RobotState:
        return await self.move(Target(Joints(stroke.joints)), timeout_s=timeout_s)

    async def stop(self, *, clean: bool) -> None:
        self.stops.append(clean)
        if self.stop_fails:
            raise DeviceFault("the controller does not answer")
        if self.stop_hangs:
            await asyncio.sleep(60)
        self.moving = False


class ToyCamera:
    async def identity(self) -> Identity:
        return Identity("toy", "bench camera", "C-1")

    async def grab(self, *, exposed_after: float) -> Frame:
        seed = int.from_bytes(hashlib.sha256(SAMPLE.get().encode()).digest()[:8], "big")
        noise = np.random.default_rng(seed).integers(0, 255, (24, 32), dtype=np.uint8)
        await asyncio.sleep(0)
        return Frame(noise, exposed_after, 0.01, 1)


class ToyProjector:
    async def identity(self) -> Identity:
        return Identity("toy", "bench projector")

    async def show(self, image: Image) -> float:
        return time.monotonic()


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ToyParams(Params):
    views: int = Field(default=5, ge=1, le=1000)
    scale: float = 1.0


async def survey(run: Run, cell: Cell, params: ToyParams) -> Result:
    """Move, look, record, solve in the child: what real procedures do, in small."""
    await run.step("collect", params.views)
    for number in range(params.views):
        key = f"view-{number:03d}"
        if key not in run.samples():
            await run.checkpoint(f"view {number}")
            await take(run, cell, key, number)
        run.progress(number + 1)
    points = np.array([sample.data["point"] for sample in run.samples("collect").values()])
    line = await run.call(functions.fit, points, timeout_s=20)
    reasons = () if params.scale > 0 else ("the scale is not positive",)
    return Result(
        "pass" if not reasons else "fail",
        reasons,
        {"line": line, "views": len(points)},
        {"slope": line[0] * params.scale, "offset": line[1]},
    )


async def take(run: Run, cell: Cell, key: str, number: int) -> None:
    async with run.taking(key):
        goal = np.full((1, 6), 0.1 * (number % 7))
        state = await cell.robot.move(Target(Joints(goal), run.speed), timeout_s=5)
        frame = await cell.camera.grab(exposed_after=state.t)
        point = [number, float(frame.image.mean()) + 1 / 3]
        await run.sample(key, {"point": point}, {"camera": frame.image})


async def chained(run: Run, cell: Cell, params: ToyParams) -> Result:
    first = await survey(run.scope("first"), cell, params)
    second = await survey(run.scope("second"), cell, params)
    lines = [dict(part.data)["line"] for part in (first, second)]
    return Result("pass", (), {"lines": lines})


class NestedParams(Params):
    survey: ToyParams = ToyParams()


async def nested(run: Run, cell: Cell, params: NestedParams) -> Result:
    return await survey(run.scope("survey"), cell, params.survey)


async def asking(run: Run, cell: Cell, params: ToyParams) -> Result:
    colour = await run.ask("Which colour?", ["red", "blue"])
    sure = await run.ask(f"Really {colour}?", ["yes", "no"])
    return Result("pass", (), {"colour": colour, "sure": sure})


async def impatient(run: Run, cell: Cell, params: ToyParams) -> Result:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(0.05):
            await run.ask("Anybody here?", ["yes"])
    await run.record("nobody")
    return await survey(run, cell, params)


class Trouble(Params):
    kind: str
    seconds: float = 60.0


async def troubled(run: Run, cell: Cell, params: Trouble) -> Result:
    """Ends in one of the ways in which procedures should not."""
    await run.step("collect", 1)
    await TROUBLES[params.kind](run, params)
    return Result("pass")


async def _bad_input(run: Run, params: Trouble) -> None:
    raise BadInput("the board is upside down")


async def _fault(run: Run, params: Trouble) -> None:
    raise DeviceFault("the camera was unplugged")


async def _defect(run: Run, params: Trouble) -> None:
    int("seven")


async def _strange_fault(run: Run, params: Trouble) -> None:
    name = os.fsdecode(b"/dev/caf\xe9")
    raise DeviceFault(f"cannot open {name}", path=name)


async def _strange_defect(run: Run, params: Trouble) -> None:
    Path(os.fsdecode(b"/nowhere/caf\xe9")).read_bytes()  # noqa: ASYNC240 - it is not there


async def _child_defect(run: Run, params: Trouble) -> None:
    await run.call(functions.divide_by_zero, timeout_s=20)


async def _child_death(run: Run, params: Trouble) -> None:
    await run.call(functions.exit_with, 4, timeout_s=20)


async def _group(run: Run, params: Trouble) -> None:
    async with asyncio.TaskGroup() as group:
        group.create_task(_fail_later())
        group.create_task(asyncio.sleep(60))


async def _not_finite(run: Run, params: Trouble) -> None:
    await run.sample("one", {"residual": float("nan")})


async def _not_json(run: Run, params: Trouble) -> None:
    await run.sample("one", {"thing": object()})


async def _twice(run: Run, params: Trouble) -> None:
    await run.sample("one", {})
    await run.sample("one", {})


async def _cancels_itself(run: Run, params: Trouble) -> None:
    raise asyncio.CancelledError


async def _stubborn(run: Run, params: Trouble) -> None:
    end = time.monotonic() + params.seconds
    while (left := end - time.monotonic()) > 0:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(left)


async def _late_fault(run: Run, params: Trouble) -> None:
    try:
        await asyncio.sleep(60)
    except asyncio.CancelledError:
        raise DeviceFault("the arm did not stop when it was told to") from None


async def _not_enabled(run: Run, params: Trouble) -> None:
    raise NotEnabled("the permission to move ended")


async def _busy(run: Run, params: Trouble) -> None:
    """Swallows its cancellation, and then computes and computes."""
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.sleep(params.seconds)
    while True:
        await run.checkpoint()


async def _wait(run: Run, params: Trouble) -> None:
    await asyncio.sleep(params.seconds)


async def _fail_later() -> None:
    await asyncio.sleep(0)
    raise DeviceFault("the projector went dark")


TROUBLES = {
    "bad input": _bad_input,
    "fault": _fault,
    "defect": _defect,
    "strange fault": _strange_fault,
    "strange defect": _strange_defect,
    "child defect": _child_defect,
    "child death": _child_death,
    "group": _group,
    "not finite": _not_finite,
    "not json": _not_json,
    "twice": _twice,
    "cancels itself": _cancels_itself,
    "stubborn": _stubborn,
    "late fault": _late_fault,
    "not enabled": _not_enabled,
    "busy": _busy,
    "wait": _wait,
}


async def no_result(run: Run, cell: Cell, params: ToyParams) -> Any:
    return {"verdict": "pass"}


async def look_up(run: Run, cell: Cell, params: ToyParams) -> Result:
    """Says what calibration it was given."""
    return Result("pass", (), {"calibration": run.calibration})


PROCEDURES = (
    Procedure("survey", "Move, look, solve", ToyParams, moves=True, run=survey),
    Procedure("chained", "Two surveys", ToyParams, moves=True, run=chained),
    Procedure("nested", "A survey in a scope", NestedParams, moves=True, run=nested),
    Procedure("asking", "Asks twice", ToyParams, moves=False, run=asking),
    Procedure("impatient", "Asks, with a deadline", ToyParams, moves=True, run=impatient),
    Procedure("troubled", "Ends badly", Trouble, moves=True, run=troubled),
    Procedure("no-result", "Returns nonsense", ToyParams, moves=False, run=no_result),
    Procedure("look-up", "Reads the calibration", ToyParams, moves=False, run=look_up),
)


@dataclass
class Bench:
    """An engine on a data directory, and the devices below it."""

    directory: Path
    store: Store
    engine: Engine
    robot: ToyRobot
    solver: Solver
    seen: list[Published] = field(default_factory=list)

    async def start(self, procedure: str, request_id: str = "request-1", **params: Any) -> str:
        """Start a run and return its id."""
        request = RunRequest(request_id=request_id, client="test", params=params)
        return (await self.engine.start(procedure, request)).run_id

    async def resume(self, run_id: str) -> RunAccepted:
        return await self.engine.resume(ResumeRequest(run_id=run_id, client="test"))

    async def cancel(self, run_id: str | None = None) -> Accepted:
        return await self.engine.cancel(CancelRequest(run_id=run_id, client="test"))

    async def ack(self, answer: str = "ok", question: int | None = None) -> Accepted:
        """Acknowledge a fault, or answer the question with this id (None: what is asked now)."""
        asked = self.engine.state().question
        if question is None and asked is not None:
            question = asked.id
        return await self.engine.ack(AckRequest(answer=answer, question=question, client="test"))

    async def phase(self, *phases: str) -> State:
        """Wait until the engine is in one of these phases."""
        await self.until(lambda: self.engine.state().phase in phases)
        return self.engine.state()

    async def ended(self, run_id: str) -> RunInfo:
        """Wait for a run's end."""
        await self.phase("idle", "fault")
        return await self.engine.run_info(run_id)

    async def until(self, condition: Callable[[], Any]) -> None:
        async with asyncio.timeout(20):
            while not condition():  # noqa: ASYNC110 - conditions of all kinds, in tests
                await asyncio.sleep(0.002)

    def events(self) -> list[str]:
        return [event.kind for event in self.engine.events().events]

    def journal(self, run_id: str) -> list[Entry]:
        return read(self.directory / "runs" / run_id / "journal.jsonl").intact()


@contextlib.asynccontextmanager
async def bench(
    directory: Path,
    *,
    robot: ToyRobot | None = None,
    document: dict[str, Any] | None = None,
    enabled: bool = True,
    limits: Limits = LIMITS,
    procedures: Sequence[Procedure] = PROCEDURES,
    **options: Any,
) -> AsyncIterator[Bench]:
    """As the daemon does it: config, cell, store, engine; and down again in order."""
    config = parse_config(document or cells.document(), "toy")
    robot = robot or ToyRobot()
    async with contextlib.AsyncExitStack() as stack:
        solver = await stack.enter_async_context(Child("solver"))
        store = await Store.open(directory)
        stack.push_async_callback(store.close)
        devices = (robot, ToyCamera(), ToyProjector())
        sheets = SheetLedger(directory, store.in_order)
        cell = Cell(config, guard_of(config), *devices, solver, sheets)
        gate = Gate(Permission(directory, always=enabled))
        robot.allowed = gate.require
        engine = Engine(cell, procedures, store, gate, limits=limits, **options)
        stack.push_async_callback(engine.shutdown)
        made = Bench(directory, store, engine, robot, solver)
        engine.subscribe(made.seen.append)
        yield made
