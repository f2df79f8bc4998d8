"""What a procedure may do besides move: say where it is, record, ask, and have maths done.

Everything that is recorded is on disk when the call returns. A resumed run starts the procedure
again; it finds what was recorded and leaves out what is done.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ValidationError

from cellctl.cell import Cell, Solver
from cellctl.drivers.base import SAMPLE, Image
from cellctl.errors import BadInput, SolveError
from cellctl.explain import explain
from cellctl.messages import Progress, Verdict
from cellctl.store.history import Sample, address
from cellctl.store.store import RunRecord

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
CALL_S = 120.0
GO, GO_ON, CANCEL = "go", "go on without asking", "cancel"


@dataclass(frozen=True)
class Result:
    """What a procedure comes to. A failed verdict has reasons; `data` and `calibration` are JSON.

    A `calibration` becomes an immutable file, whatever the verdict; it is never active by itself.
    """

    verdict: Verdict
    reasons: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    calibration: Mapping[str, Any] | None = None

    @classmethod
    def judged(
        cls,
        reasons: Sequence[str],
        data: Mapping[str, Any],
        calibration: Mapping[str, Any] | None = None,
    ) -> Result:
        """A failed one when there are reasons, else one that passes."""
        return cls("fail" if reasons else "pass", reasons, data, calibration)

    @classmethod
    def unsolved(cls, kind: str, error: SolveError) -> Result:
        """A failed one of a procedure whose data determine no answer."""
        return cls("fail", [error.message], {"kind": kind})

    def __post_init__(self) -> None:
        if self.verdict not in ("pass", "fail"):
            raise ValueError(f"a verdict is 'pass' or 'fail', not {self.verdict!r}")
        if self.verdict == "fail" and not self.reasons:
            raise ValueError("a failed verdict needs its reasons")


@dataclass(frozen=True)
class Procedure:
    """A procedure that can be asked for by name. `moves`: it needs the permission to move.

    `conclude` is its pure part, from what was recorded to the result: `run` ends with it, and it
    is all that solving a run again needs.
    """

    name: str
    summary: str
    params: type[BaseModel]
    moves: bool
    run: Callable[[Run, Cell, Any], Awaitable[Result]]
    conclude: Callable[[Any], Result] | None = None

    def __post_init__(self) -> None:
        if self.params.model_config.get("extra") != "forbid":
            raise ValueError(f"{self.params.__name__}: a misspelt parameter would be ignored")

    def parse(self, given: Mapping[str, Any]) -> BaseModel:
        """The parameters, checked. BadInput names the one that is wrong, or unknown and nearest."""
        try:
            return self.params.model_validate(dict(given))
        except ValidationError as error:
            reasons = explain(error, self.params, what="parameter")
            raise BadInput(f"{self.name}: {reasons}") from None


class Host(Protocol):
    """What the engine does for its run."""

    def check(self) -> None:
        """CancelledError when the run was asked to stop."""
        ...

    def show(self, progress: Progress) -> None: ...

    def tell(self, kind: str, **data: Any) -> None:
        """Publish an event."""
        ...

    async def ask(self, text: str, choices: Sequence[str]) -> str: ...


class Stepping:
    """Whether every checkpoint asks; shared by a run and its scopes."""

    def __init__(self, on: bool) -> None:
        self.on = on


class Run:
    """One run, as its procedure sees it. `scope` gives the procedures that it chains their own."""

    def __init__(
        self,
        record: RunRecord,
        host: Host,
        solver: Solver,
        *,
        scope: str = "",
        stepping: Stepping | None = None,
        calibration: Mapping[str, Any] | None = None,
    ) -> None:
        self._record = record
        self._host = host
        self._solver = solver
        self._scope = scope
        self._stepping = stepping or Stepping(record.header.step)
        self._step = ""
        self._total = 0
        self.calibration = calibration
        """The calibration that was active when the run was started, if any."""

    @property
    def run_id(self) -> str:
        return self._record.header.run_id

    @property
    def speed(self) -> float:
        """Fraction (0, 1] of the configured speed that was asked for."""
        return self._record.header.speed / 100.0

    @property
    def directory(self) -> Path:
        """Of the run; a report may be put there. Images are recorded with `sample`."""
        return self._record.directory

    def scope(self, name: str, *, calibration: Mapping[str, Any] | None = None) -> Run:
        """A view whose steps, samples and records are kept apart from this one's by `name`.

        `calibration`: what the procedure that is chained shall see in place of the active one.
        """
        return Run(
            self._record,
            self._host,
            self._solver,
            scope=address(self._scope, _named("scope", name)),
            stepping=self._stepping,
            calibration=self.calibration if calibration is None else calibration,
        )

    async def step(self, name: str, total: int = 0) -> None:
        """Begin a step of `total` parts; what is sampled from here on belongs to it."""
        self._step, self._total = _named("step", name), total
        await self._record.append("step", at=address(self._scope, name), total=total)
        self._host.tell("step", scope=self._scope, step=name, total=total)
        self.progress(len(self.samples()))

    def progress(self, done: int, text: str = "") -> None:
        """Tell whoever watches that `done` parts of the step are done. Not journalled."""
        self._host.show(
            Progress(
                run_id=self.run_id,
                step=address(self._scope, self._step),
                done=done,
                total=self._total,
                text=text,
            )
        )

    async def record(self, kind: str, /, **data: Any) -> None:
        """Journal something that `recall` finds again, such as a view that was rejected."""
        await self._record.append("record", at=self._scope, name=kind, data=data)
        self._host.tell("record", scope=self._scope, name=kind)

    def recall(self, kind: str) -> dict[str, Any] | None:
        """What was recorded last as `kind` in this scope, before or after a resume."""
        found = self.records(kind)
        return found[-1] if found else None

    def records(self, kind: str) -> list[dict[str, Any]]:
        """All that was recorded as `kind` in this scope, oldest first."""
        return self._record.history.records(self._scope, kind)

    async def sample(
        self, key: str, data: Mapping[str, Any], images: Mapping[str, Image] | None = None
    ) -> Sample:
        """Journal a sample of the current step, its images first. A key is taken once.

        `images`: (h, w) or (h, w, 3) of uint8. Returns the sample as `samples` gives it later.
        """
        images = dict(images or {})
        for name in (key, *images):
            _named("sample", name)
        if key in self.samples():
            raise ValueError(f"{self.address(key)}: this sample was taken already")
        step = self._current_step()
        await self._record.append_sample(address(self._scope, step), key, data, images)
        self._host.tell("sample", scope=self._scope, step=step, key=key)
        return self.samples()[key]

    def samples(self, step: str | None = None) -> dict[str, Sample]:
        """The samples of a step (None: the current one) by key, in the order they were taken."""
        return self._record.history.samples(address(self._scope, step or self._current_step()))

    def all_samples(self) -> dict[str, dict[str, Sample]]:
        """The samples of the whole run, by `<scope>/<step>` and key."""
        return self._record.history.steps()

    @contextlib.asynccontextmanager
    async def taking(self, key: str) -> AsyncIterator[None]:
        """While a sample is being taken: drivers know its name, `<scope>/<step>/<key>`.

        The name is the same in every run, so that a sample that was cut short by a crash is
        taken again as the same one. Another attempt with other poses needs another key.
        """
        token = SAMPLE.set(self.address(_named("sample", key)))
        try:
            yield
        finally:
            SAMPLE.reset(token)

    def address(self, key: str) -> str:
        """`<scope>/<step>/<key>`: how a sample of the current step is called in the whole run."""
        return address(self._scope, self._current_step(), key)

    async def checkpoint(self, text: str = "the next motion") -> None:
        """A place to stop at: lets the daemon work, raises CancelledError when the run is to end,
        and asks the operator first when the run was started with `--step`."""
        await asyncio.sleep(0)
        self._host.check()
        if not self._stepping.on:
            return
        answer = await self.ask(f"Next: {text}", [GO, GO_ON, CANCEL])
        if answer == CANCEL:
            raise StepCancelled
        self._stepping.on = answer == GO

    async def ask(self, text: str, choices: Sequence[str] = ("ok",)) -> str:
        """Wait for an operator's answer, one of `choices`. A resumed run asks again."""
        return await self._host.ask(text, choices)

    async def call(
        self, function: Callable[..., Any], *args: Any, timeout_s: float = CALL_S
    ) -> Any:
        """Evaluate a pure function in the solver's process; see `worker.Child.call`."""
        return await self._solver.call(function, *args, timeout_s=timeout_s)

    def _current_step(self) -> str:
        if not self._step:
            raise ValueError("a sample belongs to a step: call run.step first")
        return self._step


class StepCancelled(Exception):
    """The operator chose to cancel where a run with `--step` asked."""


def _named(what: str, name: str) -> str:
    if not NAME.fullmatch(name):
        raise ValueError(f"the name of a {what} is made of A-Z a-z 0-9 _ -, not {name!r}")
    return name
