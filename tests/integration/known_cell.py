"""A simulated cell that is calibrated from the start, for tests of pen and paper alone.

The calibration is made from the truth, with errors as large as those of a run; no board has to be
looked at. Only the set-up and the scoring of a test know the truth.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import tomllib
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cellctl.bus.client import Client
from cellctl.bus.follow import Update
from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.projector import LensPrior, solve_projector
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.table import solve_table
from cellctl.calib.table_surface import Area, TableSurface
from cellctl.geometry import Array, Transform
from cellctl.messages import Progress, Question, RunInfo
from cellctl.sim.cell_config import to_toml
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.grid import touched_height
from cellctl.sim.launch import endpoint_file
from cellctl.sim.presets import PRESETS
from cellctl.sim.scoring import FaultPlanter, Scorer
from cellctl.sim.truth import Truth, draw
from cellctl.store import calibrations, sheets
from cellctl.store.files import write_document
from tests.integration.cellrun import CellRun

KNOWN, BOWED = "cal-known", "cal-bowed"
"""Calibrations that are there: the active one, and one that says the table bows."""
BOW_M = 3e-3
CAMERA_OFF_M, CAMERA_OFF_RAD = 2e-3, 1e-3
MARKER_SIGMA_PX, TOUCH_SIGMA_M = 0.07, 5e-5
PICTURES, EDGE_PX = 4, 40
SILENCE_S = 60.0
FRESH = "fresh paper lies on "

T = TypeVar("T")
Look = Callable[[Update], None]
Answer = Callable[[Question], str]


def known_calibration(truth: Truth, *, bow_m: float = 0.0) -> Calibration:
    """The truth of a cell, seen as a good run would see it. With `bow_m` its table is said to bow
    by that much, which it does not."""
    rng = np.random.default_rng(truth.seed)
    lens = truth.camera.lens
    camera = CameraModel(lens.matrix, lens.distortion, lens.size)
    turn, shift = rng.normal(0, CAMERA_OFF_RAD, 3), rng.normal(0, CAMERA_OFF_M, 3)
    pose = truth.camera.pose @ Transform.from_rvec("camera", "camera", turn, shift)
    level = Plane.horizontal(touched_height(truth))
    light = _light(truth, camera, rng)
    boards = {"markers": truth.boards["markers"].pose}
    known = Calibration(
        camera=camera, T_world_camera=pose, table=level, projector=light, boards=boards
    )
    return known.on(_surface(truth, bow_m, rng))


def _light(truth: Truth, camera: CameraModel, rng: np.random.Generator) -> ProjectorMap:
    """The map from the picture to the projector, from markers all over the projector's image."""
    projector = truth.preset.projector
    (width, height), lens_size = projector.size_px, truth.camera.lens.size
    columns = np.linspace(EDGE_PX, width - EDGE_PX, 20)
    rows = np.linspace(EDGE_PX, height - EDGE_PX, 12)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    seen = truth.camera.project(truth.light_lands(pixels))
    seen += rng.normal(0, MARKER_SIGMA_PX, seen.shape)
    inside = ((seen > 5) & (seen < np.array(lens_size) - 6)).all(axis=1)
    pictures = [
        {int(i): seen[i] for i in np.nonzero(inside)[0] if i % PICTURES == k}
        for k in range(PICTURES)
    ]
    prior = LensPrior(projector.throw_ratio * width, np.array(projector.centre_px))
    return solve_projector(pictures, dict(enumerate(pixels)), camera, lens=prior).map


def _surface(truth: Truth, bow_m: float, rng: np.random.Generator) -> TableSurface:
    """The table as 5 x 5 touches show it."""
    preset = truth.preset.table
    half, middle = np.array(preset.area_m) / 2, np.array(preset.centre_m[:2])
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)
    xy = middle + steps * half
    z = np.array([_height(truth, place) for place in xy])
    z += touched_height(truth) - z.mean() + rng.normal(0, TOUCH_SIGMA_M, len(z))
    z += bow_m * (steps**2).sum(axis=1)
    return solve_table(np.column_stack([xy, z]), area=Area(middle - half, middle + half))


def _height(truth: Truth, xy: Array) -> float:
    return float(truth.table.hit(np.append(xy, 10.0), np.array([[0.0, 0.0, -1.0]]))[0, 2])


class KnownCell(CellRun):
    """A CellRun with an active calibration, the doors of its world, and a person who lays fresh
    paper when a run asks for it."""

    def __init__(
        self, folder: Path, *, seed: int = 0, cell: str = "cr", full: bool = False,
        pen: dict[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """`full`: no free paper is left. `pen` is to change in the config."""
        super().__init__(folder, seed, cell)
        self._true = draw(PRESETS[cell], seed)
        document = tomllib.loads(self.config.read_text())
        document["bracket"]["pen"].update(pen or {})
        self.config.write_text(to_toml(document))
        (folder / "calibrations").mkdir()
        self._put(BOWED, known_calibration(self._true, bow_m=BOW_M))
        self._put(KNOWN, known_calibration(self._true))
        self.strokes = 0
        """How many the world has seen."""
        if full:
            self._fill()

    def _put(self, name: str, calibration: Calibration) -> None:
        """Make a calibration the active one."""
        content = {"calibration_id": name, "verdict": "pass", "reasons": [], "provenance": {}}
        content["calibration"] = calibration.to_dict()
        write_document(self.folder / "calibrations" / f"{name}.json", calibrations.FILE, content)
        promoted = {"calibration_id": name, "promoted": "", "client": "test", "verdict": "pass"}
        active = {"active": name, "history": [promoted]}
        write_document(self.folder / "active.json", calibrations.ACTIVE, active)

    def _fill(self) -> None:
        """All of the paper is said to be drawn on."""
        spot = {"x": 0.0, "y": 0.0, "radius_m": 5.0, "owner": "before", "state": "drawn"}
        paper = {"A": {"laid": 1, "spots": [spot]}}
        write_document(self.folder / sheets.FILE, sheets.SHEETS, {"sheets": paper})

    def run(
        self, procedure: str, *, answer: Answer | None = None, look: Look | None = None,
        **params: Any,
    ) -> RunInfo:  # fmt: skip
        """A run, to its end; its questions are answered, by default with fresh paper."""
        with self.client() as client:
            run_id = client.run(procedure, params).run_id
            info = self.watch(client, run_id, answer or self.lay_paper, look)
        self.strokes += sum(c["state"] == "drawn" for c in self.circles(run_id).values())
        self.strokes += len(self.samples(run_id, "touches"))  # the pen is lifted by a stroke
        return info

    def watch(
        self, client: Client, run_id: str, answer: Answer, look: Look | None = None
    ) -> RunInfo:
        """Answer what the run asks until it has ended."""
        answered: set[int] = set()
        for update in client.watch(run_id, give_up_s=SILENCE_S):
            if look is not None and isinstance(update, Progress):
                look(update)
            question = client.state().question
            if question is not None and question.id not in answered:
                answered.add(question.id)
                client.ack(answer(question), question=question.id)
        return client.run_info(run_id)

    def lay_paper(self, question: Question) -> str:
        """A person does what is asked for."""
        assert question.choices[0].startswith(FRESH), question.text
        self.plant("sheet.replace")
        return question.choices[0]

    def promote(self, calibration_id: str | None) -> None:
        assert calibration_id is not None
        with self.client() as client:
            client.promote(calibration_id)

    def calibration(self, calibration_id: str | None) -> Calibration:
        assert calibration_id is not None
        with self.client() as client:
            document = client.calibration(calibration_id).document
        return Calibration.from_dict(document["calibration"], calibration_id)

    def samples(self, run_id: str, step: str) -> dict[str, dict[str, Any]]:
        """The data of the journalled samples of a step."""
        lines = [json.loads(line) for line in self.journal(run_id)]
        taken = [x["data"] for x in lines if x["kind"] == "sample" and x["at"] == step]
        return {sample["key"]: sample["data"] for sample in taken}

    def circles(self, run_id: str) -> dict[str, dict[str, Any]]:
        return self.samples(run_id, "circles")

    def plant(self, verb: str, **arguments: Any) -> None:
        """Through the door of faults."""

        async def through() -> None:
            planter = FaultPlanter(read_endpoint(endpoint_file(self.folder)))
            try:
                await planter.plant(verb, **arguments)
            finally:
                await planter.close()

        asyncio.run(through())

    def ink(self) -> list[dict[str, Any]]:
        """What the world's paper shows."""
        return self._scored(lambda scorer: scorer.ink())

    def height(self, x: float, y: float) -> float:
        """Of the true table, metres."""
        return _height(self._true, np.array([x, y]))

    def tip(self) -> Array:
        """The pen's true tip (3,) in the flange frame."""
        return np.array(self._scored(lambda scorer: scorer.read())["pen"]["tip_m"])

    def camera(self) -> tuple[CameraModel, Transform]:
        """The true camera and its T_world_camera."""
        camera = self._scored(lambda scorer: scorer.read())["camera"]
        size = (camera["image_size"][0], camera["image_size"][1])
        model = CameraModel(np.array(camera["K"]), np.array(camera["distortion"]), size)
        return model, Transform("world", "camera", camera["T_world_camera"])

    def true_mm(self, calibration: Calibration) -> float:
        async def score(scorer: Scorer) -> float:
            grid: Array = await scorer.grid()
            return (await scorer.score(calibration.project(grid)))["true_mm"]

        return self._scored(score)

    def _scored(self, ask: Callable[[Scorer], Awaitable[T]]) -> T:
        async def through() -> T:
            scorer = Scorer(read_endpoint(endpoint_file(self.folder)))
            try:
                return await ask(scorer)
            finally:
                await scorer.close()

        return asyncio.run(through())


@contextlib.contextmanager
def known_cell(folder: Path, **options: Any) -> Iterator[KnownCell]:
    """A KnownCell with a running daemon; nothing of it is left afterwards."""
    cell = KnownCell(folder, **options)
    try:
        cell.start()
        yield cell
    finally:
        cell.close()
