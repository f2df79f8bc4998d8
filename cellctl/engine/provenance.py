"""What a run is made with: versions, the config and its hash, the devices that answered."""

from __future__ import annotations

import asyncio
import hashlib
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import metadata
from typing import Any

from cellctl.cell import Cell
from cellctl.drivers.base import Camera, Projector, Robot
from cellctl.errors import BadInput, DeviceFault
from cellctl.messages import RunRequest
from cellctl.store.files import to_json, utc_now
from cellctl.store.run_folder import RunHeader, new_run_id

LIBRARIES = (
    "cellctl",
    "eclipse-zenoh",
    "numpy",
    "opencv-contrib-python-headless",
    "pydantic",
    "scipy",
)
NOT_THE_CELL = ("bus", "cell")
"""Sections of the config that say where the daemon lives, and nothing about what it measures."""


@cache
def versions() -> dict[str, str]:
    """Of Python and of the libraries that results depend on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


@dataclass(frozen=True)
class Provenance:
    """The cell as it is now: its config as JSON, and its devices by name."""

    config: dict[str, Any]
    devices: dict[str, dict[str, str]]

    def header(
        self,
        procedure: str,
        params: dict[str, Any],
        request: RunRequest,
        *,
        boot: str,
        active_calibration: str | None,
    ) -> RunHeader:
        """run.json of a run that starts now."""
        return RunHeader(
            run_id=new_run_id(),
            procedure=procedure,
            params=params,
            speed=request.speed,
            step=request.step,
            request_id=request.request_id,
            client=request.client,
            cell=self.config["cell"]["id"],
            created=utc_now(),
            boot=boot,
            config_sha256=config_hash(self.config),
            config=self.config,
            versions=versions(),
            devices=self.devices,
            active_calibration=active_calibration,
        )

    def require_same(self, header: RunHeader) -> None:
        """BadInput when a run was recorded with another config or with other devices."""
        changed = changed_sections(header.config, self.config)
        changed += changed_devices(header.devices, self.devices)
        if changed:
            raise BadInput(
                f"run {header.run_id} was recorded with another {', '.join(changed)}: its samples "
                "do not fit this cell. Start a new run"
            )


async def look_at(cell: Cell, timeout_s: float) -> Provenance:
    """Ask the devices who they are. DeviceFault names one that has not answered by then."""
    devices: dict[str, Robot | Camera | Projector]
    devices = {"robot": cell.robot, "camera": cell.camera, "projector": cell.projector}
    found: dict[str, dict[str, str]] = {}
    try:
        async with asyncio.timeout(timeout_s):
            for name, device in devices.items():
                found[name] = asdict(await device.identity())
    except TimeoutError:
        silent = next(name for name in devices if name not in found)
        raise DeviceFault(f"the {silent} did not say who it is within {timeout_s:g} s") from None
    return Provenance(cell.config.model_dump(mode="json"), found)


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 of the config as JSON with sorted keys."""
    ordered = {key: config[key] for key in sorted(config)}
    return hashlib.sha256(to_json(ordered, "config")).hexdigest()


def changed_sections(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The sections that differ and that the samples of a run depend on."""
    names = sorted((set(before) | set(now)) - set(NOT_THE_CELL))
    return [f"{name} (config)" for name in names if before.get(name) != now.get(name)]


def changed_devices(
    before: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]
) -> list[str]:
    """The devices that are no longer the same ones; a new firmware does not make another."""
    return [
        f"{name} (device)"
        for name in now
        if any(before.get(name, {}).get(key) != now[name][key] for key in ("model", "serial"))
    ]
