"""One procedure, supervised from its start to its end. However it ends, the arm stands still,
the journal says how, and a person is told when something is left to look at."""

from __future__ import annotations

import asyncio
import contextlib
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import structlog

from cellctl.cell import Cell
from cellctl.engine.bulletin import Bulletin
from cellctl.engine.ending import Ending, ending_of
from cellctl.errors import BadInput, CellctlError, StorageFault
from cellctl.gate import Gate
from cellctl.messages import AckRequest, Progress, Question, RunStatus
from cellctl.run import Procedure, Result, Run, StepCancelled
from cellctl.store.files import utc_now
from cellctl.store.store import RunRecord, Store

RunEvent = Literal["ask", "answer", "withdraw", "stop"]

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Limits:
    """Deadlines in seconds: for the arm to stand still, for a cancelled procedure to end, for a
    device to say who it is."""

    stop_s: float = 15.0
    unwind_s: float = 5.0
    identity_s: float = 5.0


@dataclass(frozen=True)
class _Stop:
    """That the run was asked to end, and as what."""

    status: RunStatus
    reason: str


class ActiveRun:
    """A run while it is the active one. It is the Host of its Run.

    `fire` moves the engine's phase on: `ask`, `answer`, `withdraw` and, once, `stop`.
    """

    def __init__(
        self,
        record: RunRecord,
        *,
        procedure: Procedure,
        cell: Cell,
        store: Store,
        gate: Gate,
        bulletin: Bulletin,
        fire: Callable[[RunEvent], None],
        limits: Limits,
        calibration: Mapping[str, Any] | None,
    ) -> None:
        self.record = record
        self.procedure = procedure
        self.progress: Progress | None = None
        self.question: Question | None = None
        self.hung: asyncio.Task[Result] | None = None
        self._params = procedure.parse(record.header.params)
        self._cell = cell
        self._store = store
        self._gate = gate
        self._bulletin = bulletin
        self._fire = fire
        self._limits = limits
        self._run = Run(record, self, cell.solver, calibration=calibration)
        self._asking = asyncio.Lock()
        self._answer: asyncio.Future[str] | None = None
        self._task: asyncio.Task[Result] | None = None
        self._stop: _Stop | None = None
        self._stop_asked = asyncio.Event()
        self._stopping = False

    @property
    def run_id(self) -> str:
        return self.record.header.run_id

    # -- what the engine asks of it

    def stop(self, status: RunStatus, reason: str) -> bool:
        """End the run as `cancelled` or `interrupted`; False when it is ending already."""
        if self._stopping:
            return False
        self._stop = _Stop(status, reason)
        self._stop_asked.set()
        if self._task is not None:
            self._task.cancel()
        self._enter_stopping()
        return True

    def answer(self, request: AckRequest) -> None:
        """Answer the question. BadInput when it is another one's answer, not a choice, or may be
        meant for another question: with a choice, the question has to be named."""
        question, future = self.question, self._answer
        if question is None or future is None or future.done():
            raise BadInput("the question was answered already")
        if request.question not in (None, question.id):
            raise BadInput(
                f"question {request.question} is no longer asked; now it is {question.id}: "
                f"{question.text}"
            )
        if request.answer not in question.choices:
            raise BadInput(
                f"{request.answer!r} is not an answer to {question.text!r}; choose one of: "
                f"{', '.join(question.choices)}",
                choices=question.choices,
            )
        if request.question is None and len(question.choices) > 1:
            raise BadInput(
                f"say which question is answered; {question.text!r} is number {question.id}: "
                f"cellctl ack --answer {shlex.quote(request.answer)} --question {question.id}",
                question=question.id,
            )
        future.set_result(request.answer)
        self.question = None
        self._fire("answer")

    async def supervise(self) -> Ending:
        """Run the procedure, or finish what an earlier life of this run came to."""
        outcome = self._come_to() or await self._outcome()
        ending = outcome if isinstance(outcome, Ending) else await self._conclude(outcome)
        if self.procedure.moves and ending.status != "done":
            ending = _with_fault(ending, await self._halt(clean=ending.fault is None))
        return await self._close(ending)

    async def forsake(self, problem: str) -> Ending:
        """The ending for a defect in the supervision itself. The arm is stopped, the procedure
        cancelled, and the journal closed as it is; whatever fails of that, the rest is done."""
        if not self._stopping:
            with self._regardless():
                self._enter_stopping()
        fault = f"a defect of the program ({problem}): look at the arm, restart the daemon"
        ending = Ending("interrupted", problem, fault=fault)
        with self._regardless():
            ending = _with_fault(ending, await self._halt(clean=False))
        with self._regardless():
            ending = _with_fault(ending, await self._give_up(self._task))
        with self._regardless():
            await self.record.close()
        self.record.presume(
            status="interrupted", error=problem, fault=ending.fault, ended=utc_now()
        )
        return ending

    # -- Host

    def check(self) -> None:
        if self._stop is not None:
            raise asyncio.CancelledError

    def show(self, progress: Progress) -> None:
        self.progress = progress
        self._bulletin.publish(progress)

    def tell(self, kind: str, **data: Any) -> None:
        self._bulletin.event(kind, self.run_id, **data)

    async def ask(self, text: str, choices: Sequence[str]) -> str:
        async with self._asking:
            entry = await self.record.append("question", text=text, choices=list(choices))
            self.check()
            number = entry.n
            self._answer = asyncio.get_running_loop().create_future()
            self.question = Question(id=number, text=text, choices=list(choices))
            self._fire("ask")
            self.tell("question", id=number, **entry.data)
            try:
                answer = await self._answer
            except asyncio.CancelledError:
                await self._withdraw(number)
                raise
            await self.record.append("answer", question=number, answer=answer)
            self.tell("answer", question=number, answer=answer)
            return answer

    async def _withdraw(self, number: int) -> None:
        """The procedure itself no longer wants to know, as when it set a deadline."""
        if self.question is None:  # it was answered, or the run is stopping
            return
        self.question = None
        self._fire("withdraw")
        await self.record.append("withdrawn", question=number)

    # -- from the procedure's start to its outcome

    def _enter_stopping(self) -> None:
        self._stopping = True
        self._gate.shut()
        self.question = None
        self._fire("stop")

    def _come_to(self) -> dict[str, Any] | None:
        result = self.record.history.result()
        if result is not None and not self._stopping:
            self._enter_stopping()
            return result
        return None

    async def _outcome(self) -> dict[str, Any] | Ending:
        """The result as it was journalled, or how the procedure ended without one."""
        task = asyncio.create_task(self._perform(), name=f"procedure {self.procedure.name}")
        self._task = task
        asked = asyncio.create_task(self._stop_asked.wait(), name="stop asked")
        try:
            await asyncio.wait({task, asked}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            asked.cancel()
        if self._stop is not None:
            return await self._unwind(task, self._stop)
        self._enter_stopping()
        error = task.exception() if not task.cancelled() else asyncio.CancelledError()
        return await self._journal_result(task.result()) if error is None else _ending_of(error)

    async def _perform(self) -> Result:
        self.check()
        if self.procedure.moves:
            self._gate.admit()
        result = await self.procedure.run(self._run, self._cell, self._params)
        if not isinstance(result, Result):
            raise TypeError(f"{self.procedure.name} returned {type(result).__name__}, no Result")
        return result

    async def _journal_result(self, result: Result) -> dict[str, Any] | Ending:
        try:
            entry = await self.record.append(
                "result",
                verdict=result.verdict,
                reasons=list(result.reasons),
                data=dict(result.data),
                calibration=None if result.calibration is None else dict(result.calibration),
            )
        except Exception as error:  # noqa: BLE001 - classified, journalled and told
            return ending_of(error)
        return entry.data

    async def _unwind(self, task: asyncio.Task[Result], stop: _Stop) -> Ending:
        """Wait for the end of the procedure that `stop` cancelled; its result no longer counts."""
        ending = Ending(stop.status, stop.reason)
        await asyncio.wait({task}, timeout=self._limits.unwind_s)
        if not task.done():
            ending = _with_fault(ending, await self._halt(clean=False))
            problem = await self._give_up(task)
            if problem is not None:
                return _with_fault(ending, problem)
        error = None if task.cancelled() else task.exception()
        if error is None:
            return ending
        log.error("while a run was being stopped", run=self.run_id, exc_info=error)
        return _with_fault(ending, ending_of(error).fault)

    async def _give_up(self, task: asyncio.Task[Result] | None) -> str | None:
        """Cancel the procedure once more. None when it ends, else what a person has to know."""
        if task is None:
            return None
        task.cancel()
        await asyncio.wait({task}, timeout=self._limits.unwind_s)
        if task.done():
            return None
        self.hung = task
        return f"{self.procedure.name} does not end when it is told to: restart the daemon"

    @contextlib.contextmanager
    def _regardless(self) -> Iterator[None]:
        """What is raised inside is logged, and the next thing is done."""
        try:
            yield
        except Exception:
            log.exception("while a run was being forsaken", run=self.run_id)

    async def _halt(self, *, clean: bool) -> str | None:
        """Stop the arm. None when it stands still, else what a person has to know."""
        if not self.procedure.moves:
            return None
        task = asyncio.create_task(self._cell.robot.stop(clean=clean), name="stop the arm")
        done, _ = await asyncio.wait({task}, timeout=self._limits.stop_s)
        if not done:
            task.cancel()
            problem = f"no standstill within {self._limits.stop_s:g} s"
        elif task.cancelled():
            problem = "the stop was cancelled"
        elif error := task.exception():
            problem = error.message if isinstance(error, CellctlError) else repr(error)
        else:
            return None
        log.error("the arm could not be stopped", run=self.run_id, problem=problem)
        return f"the arm could not be stopped ({problem}): press the emergency stop and look"

    # -- what is left behind

    async def _conclude(self, result: dict[str, Any]) -> Ending:
        """Store what the journal's result says. Done again after a crash, it does the same."""
        try:
            calibration_id = await self._store_calibration(result)
            content = {**result, "calibration_id": calibration_id}
            del content["calibration"]
            header = self.record.header
            await self.record.write_result(
                {"run_id": header.run_id, "procedure": header.procedure, **content}
            )
        except Exception as error:  # noqa: BLE001 - classified, journalled and told
            return ending_of(error)
        return Ending(
            "done",
            verdict=result["verdict"],
            reasons=tuple(result["reasons"]),
            calibration_id=calibration_id,
        )

    async def _store_calibration(self, result: dict[str, Any]) -> str | None:
        if result["calibration"] is None:
            return None
        header = self.record.header
        calibration_id = f"cal-{header.run_id}"
        content = {
            "calibration_id": calibration_id,
            "verdict": result["verdict"],
            "reasons": result["reasons"],
            "provenance": {
                "run_id": header.run_id,
                "procedure": header.procedure,
                "cell": header.cell,
                "config_sha256": header.config_sha256,
                "versions": header.versions,
                "devices": header.devices,
                "stored": utc_now(),
            },
            "calibration": result["calibration"],
        }
        await self._store.in_order(self._store.calibrations.add, calibration_id, content)
        return calibration_id

    async def _close(self, ending: Ending) -> Ending:
        """Journal the end. When the disk refuses, the run is interrupted, as it will be found."""
        try:
            await self.record.append(ending.status, **ending.as_data())
        except StorageFault as problem:
            ending = replace(_with_fault(ending, problem.message), status="interrupted")
            self.record.presume(
                status="interrupted", error=ending.error, fault=ending.fault, ended=utc_now()
            )
        await self.record.close()
        return ending


def _ending_of(error: BaseException) -> Ending:
    if isinstance(error, StepCancelled):
        return Ending("cancelled", "the operator cancelled it at a checkpoint")
    return ending_of(error)


def _with_fault(ending: Ending, fault: str | None) -> Ending:
    """With one more thing to look at; nothing is said twice."""
    if fault is None or (ending.fault and fault in ending.fault):
        return ending
    return replace(ending, fault=f"{ending.fault}; {fault}" if ending.fault else fault)
