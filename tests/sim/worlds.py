"""Real world processes for tests, and the drivers that talk to them."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cellctl.config import CellConfig, SimulationSection, load_config
from cellctl.drivers.base import Path as JointPath
from cellctl.drivers.base import Target
from cellctl.geometry import Array
from cellctl.sim.drivers import SimCamera, SimProjector, SimRobot
from cellctl.sim.endpoint import Endpoint
from cellctl.sim.launch import connect_or_start, stop_world
from cellctl.sim.link import SimClock
from cellctl.sim.scoring import FaultPlanter, Scorer

CONFIG_FILE = Path(__file__).parents[2] / "config" / "sim-cr.toml"
WORK = np.radians([-76.0, -84.0, -111.0, -75.0, 90.0, -166.0])
NEAR = WORK + np.radians([6.0, 0, 0, 0, 0, 0])


def config() -> CellConfig:
    return load_config(CONFIG_FILE)


@contextlib.contextmanager
def world(
    directory: Path, seed: int = 0, time: Literal["stepped", "paced"] = "stepped"
) -> Iterator[Endpoint]:
    """A world process that ends with the test."""
    section = SimulationSection(preset="cr", seed=seed, time=time, idle_exit_s=300.0)
    try:
        yield connect_or_start(section, directory)
    finally:
        stop_world(directory)


@dataclass(frozen=True)
class Devices:
    clock: SimClock
    robot: SimRobot
    camera: SimCamera
    projector: SimProjector
    faults: FaultPlanter
    scorer: Scorer


@contextlib.asynccontextmanager
async def devices(endpoint: Endpoint) -> AsyncIterator[Devices]:
    """All drivers of a world, closed at the end."""
    clock, cell = SimClock(endpoint.time), config()
    made = Devices(
        clock,
        SimRobot(endpoint, cell, clock),
        SimCamera(endpoint, cell, clock),
        SimProjector(endpoint, cell, clock),
        FaultPlanter(endpoint),
        Scorer(endpoint),
    )
    try:
        yield made
    finally:
        for client in (made.robot, made.camera, made.projector, made.faults, made.scorer):
            await client.close()


def to(*joints: Array, speed: float = 1.0) -> Target:
    """A target through these joints."""
    return Target(JointPath(np.array(joints)), speed)
