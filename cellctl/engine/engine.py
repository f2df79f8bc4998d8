"""One run at a time, on one cell. A fault is sticky: it stays, also over a restart, until a person
acknowledges it. Nothing moves because the engine starts."""

from __future__ import annotations

import asyncio
import math
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import structlog

from cellctl.cell import Cell
from cellctl.engine.active_run import ActiveRun, Limits
from cellctl.engine.bulletin import Bulletin, Callback
from cellctl.engine.ending import Ending
from cellctl.engine.phases import PhaseEvent, transition
from cellctl.engine.provenance import look_at, versions
from cellctl.errors import BadInput, Busy, CellctlError, DeviceFault, NotFound, printable
from cellctl.gate import Gate
from cellctl.messages import (
    Accepted,
    AckRequest,
    CalibrationInfo,
    CancelRequest,
    Events,
    Phase,
    ProcedureInfo,
    Procedures,
    PromoteRequest,
    ResumeRequest,
    RunAccepted,
    RunInfo,
    RunRequest,
    Runs,
    State,
)
from cellctl.run import Procedure
from cellctl.store.run_folder import RunFolder
from cellctl.store.store import RunRecord, Store

Policy = Callable[[Mapping[str, Any], Mapping[str, Any] | None], bool]

log = structlog.get_logger(__name__)


class Engine:
    """What the bus talks to. All of it is called on the event loop.

    `gate` is what the robot of `cell` asks before it moves; the engine opens it for a run.
    `promotes` is asked whether the calibration file that a run has left takes the place of the
    active one (None: there is none) at once; nobody but a person promotes, unless a policy is
    given here. `report` is told the folder of every run that has ended, when all else is done;
    it must neither block nor fail.
    """

    def __init__(
        self,
        cell: Cell,
        procedures: Sequence[Procedure],
        store: Store,
        gate: Gate,
        *,
        limits: Limits | None = None,
        promotes: Policy = lambda _new, _active: False,
        report: Callable[[Path], None] = lambda _: None,
    ) -> None:
        self.boot = secrets.token_hex(8)
        self._cell = cell
        self._procedures = {procedure.name: procedure for procedure in procedures}
        self._store = store
        self._gate = gate
        self._limits = limits or Limits()
        self._promotes = promotes
        self._report = report
        self._bulletin = Bulletin(self.boot)
        self._commands = asyncio.Lock()
        self._active: ActiveRun | None = None
        self._driver: asyncio.Task[None] | None = None
        self._hung: asyncio.Task[Any] | None = None
        self._closing = False
        self._fault = "; ".join(self._unacknowledged().values()) or None
        self._phase: Phase = "fault" if self._fault else "idle"

    # -- what is

    def state(self) -> State:
        """A snapshot."""
        active, permission = self._active, self._gate.permission
        until = permission.until()
        config = self._cell.config
        return State(
            cell=config.cell.id,
            boot=self.boot,
            seq=self._bulletin.seq,
            phase=self._phase,
            active_run=active.run_id if active else None,
            procedure=active.procedure.name if active else None,
            question=active.question if active else None,
            fault=self._fault,
            progress=active.progress if active else None,
            active_calibration=self._store.calibrations.active,
            enabled=until is not None,
            enabled_until=None if until is None or math.isinf(until) else until,
            enable_command=permission.command if until is None else None,
            simulated=config.simulation is not None,
            wall_time=time.time(),
        )

    def events(self, since: int = 0) -> Events:
        """The events after number `since` of this boot; only the newest 1000 are kept."""
        return self._bulletin.since(since)

    def subscribe(self, callback: Callback) -> Callable[[], None]:
        """Have `callback` called, on the loop, with every State, Event and Progress; it must not
        block. Returns what ends that."""
        return self._bulletin.subscribe(callback)

    def procedures(self) -> Procedures:
        """All procedures, with the JSON schema of their parameters."""
        return Procedures(
            procedures=[
                ProcedureInfo(
                    name=procedure.name,
                    summary=procedure.summary,
                    moves=procedure.moves,
                    params=procedure.params.model_json_schema(),
                )
                for procedure in self._procedures.values()
            ]
        )

    async def runs(self, limit: int | None = None) -> Runs:
        """The newest `limit` runs (None: all), newest first, without their results."""
        newest = self._store.folders()[::-1][:limit]
        return Runs(runs=[self._info(folder) for folder in newest])

    async def run_info(self, run_id: str) -> RunInfo:
        """One run, with its result. NotFound names the newest runs."""
        info = self._info(self._store.folder(run_id))
        return info.model_copy(update={"result": printable(await self._store.result(run_id))})

    async def calibration(self, calibration_id: str) -> CalibrationInfo:
        """A calibration by its id, or `active`. NotFound lists the known ones."""
        return await self._store.in_order(self._store.calibrations.info, calibration_id)

    # -- commands

    async def start(self, name: str, request: RunRequest) -> RunAccepted:
        """Start a procedure. The same `request_id` gives the same run, also after a restart.

        Raises NotFound (no such procedure), BadInput (parameters, or a request id that was used
        for something else), Busy, NotEnabled, DeviceFault (a fault is not acknowledged, or a
        device does not answer) and StorageFault.
        """
        async with self._commands:
            procedure = self._procedure(name)
            params = procedure.parse(request.params).model_dump(mode="json")
            if (folder := self._store.requested(request.request_id)) is not None:
                return self._replayed(folder, name, params)
            self._require_free_and_permitted(procedure)
            provenance = await look_at(self._cell, self._limits.identity_s)
            active = self._store.calibrations.active
            calibration = await self._calibration(active)
            header = provenance.header(
                name, params, request, boot=self.boot, active_calibration=active
            )
            record = await self._store.create(header)
            return self._launch(record, procedure, calibration, "started")

    async def resume(self, request: ResumeRequest) -> RunAccepted:
        """Go on with an interrupted run, on its own journal. Resuming the active run does nothing.

        Raises as `start`, and BadInput when the run has ended or the cell is not the same.
        """
        async with self._commands:
            folder = self._store.folder(request.run_id)
            if self._active is not None and self._active.run_id == request.run_id:
                return RunAccepted(run_id=request.run_id, boot=self.boot, replayed=True)
            if folder.standing.status != "interrupted":
                raise BadInput(
                    f"run {request.run_id} is {folder.standing.status}; only an interrupted run "
                    "can be resumed. Start a new one"
                )
            header = folder.header
            procedure = self._procedure(header.procedure)
            procedure.parse(header.params)
            self._require_free_and_permitted(procedure)
            provenance = await look_at(self._cell, self._limits.identity_s)
            provenance.require_same(header)
            calibration = await self._calibration(header.active_calibration)
            record = await self._store.reopen(
                request.run_id,
                "resumed",
                boot=self.boot,
                client=request.client,
                versions=versions(),
                devices=provenance.devices,
            )
            return self._launch(record, procedure, calibration, "resumed")

    async def cancel(self, request: CancelRequest) -> Accepted:
        """Cancel the active run, or abandon an interrupted one; cancelling twice does no harm.

        It returns at once; that the arm stands still is told by the `ended` event.
        """
        active = self._active
        if active is not None and request.run_id in (None, active.run_id):
            stopping = active.stop("cancelled", f"cancelled by {request.client}")
            message = "the run is being cancelled" if stopping else "the run is ending already"
            return Accepted(message=message, run_id=active.run_id)
        if request.run_id is None:
            raise NotFound("nothing is running")
        async with self._commands:
            return await self._abandon(request.run_id, request.client)

    async def ack(self, request: AckRequest) -> Accepted:
        """Answer the active run's question, or acknowledge a fault.

        BadInput when there is neither, the answer is not a choice, or it comes too late.
        """
        async with self._commands:
            if self._phase == "waiting" and self._active is not None:
                self._active.answer(request)
                return Accepted(message="answered", run_id=self._active.run_id)
            if request.question is not None:
                raise BadInput(f"question {request.question} is no longer asked")
            if self._phase != "fault":
                raise BadInput("there is nothing to acknowledge: no fault and no question")
            return await self._acknowledge(request.client)

    async def promote(self, request: PromoteRequest) -> Accepted:
        """Make a calibration the active one. BadInput when it failed its verdict, unless forced."""
        async with self._commands:
            await self._promote(
                request.calibration_id,
                request.client,
                despite_failed_verdict=request.despite_failed_verdict,
            )
            return Accepted(message=f"{request.calibration_id} is the active calibration")

    async def shutdown(self) -> None:
        """Stop the arm, end the active run as interrupted, and start no other. Idempotent.

        The arm does not wait for a command that is under way, such as a promotion on a slow disk.
        """
        self._closing = True
        self._interrupt()
        async with self._commands:
            self._interrupt()  # what that command has started
            if self._driver is not None:
                await asyncio.shield(self._driver)

    # -- inside

    def _interrupt(self) -> None:
        if self._active is not None:
            self._active.stop("interrupted", "the daemon was stopped")

    def _fire(self, event: PhaseEvent) -> None:
        self._phase = transition(self._phase, event)
        self._tell_state()

    def _tell_state(self) -> None:
        """Publish a snapshot. Runs begin and end whether or not there is one."""
        try:
            self._bulletin.publish(self.state())
        except Exception:
            log.exception("there is no snapshot of the state", phase=self._phase)

    async def _calibration(self, calibration_id: str | None) -> Mapping[str, Any] | None:
        if calibration_id is None:
            return None
        document = (await self.calibration(calibration_id)).document
        return dict(document["calibration"])

    def _launch(
        self,
        record: RunRecord,
        procedure: Procedure,
        calibration: Mapping[str, Any] | None,
        how: str,
    ) -> RunAccepted:
        self._active = active = ActiveRun(
            record,
            procedure=procedure,
            cell=self._cell,
            store=self._store,
            gate=self._gate,
            bulletin=self._bulletin,
            fire=self._fire,
            limits=self._limits,
            calibration=calibration,
        )
        self._fire("start")
        header = record.header
        active.tell(how, procedure=procedure.name, params=header.params, client=header.client)
        log.info("run", run=header.run_id, procedure=procedure.name, how=how)
        self._driver = asyncio.create_task(self._drive(active), name=f"run {header.run_id}")
        return RunAccepted(run_id=header.run_id, boot=self.boot)

    async def _drive(self, active: ActiveRun) -> None:
        try:
            ending = await active.supervise()
        except Exception as error:
            log.exception("the supervision of a run failed", run=active.run_id)
            ending = await active.forsake(repr(error))
        self._active, self._fault, self._hung = None, ending.fault, active.hung
        level = log.info if ending.status in ("done", "cancelled") else log.error
        level("run ended", run=active.run_id, status=ending.status, **ending.as_data())
        self._fire("fault" if ending.fault else "end")
        data = {name: value for name, value in ending.as_data().items() if name != "traceback"}
        active.tell("ended", status=ending.status, **data)
        await self._promote_by_policy(ending)
        self._report(active.record.directory)

    async def _promote_by_policy(self, ending: Ending) -> None:
        new = ending.calibration_id
        if new is None:
            return
        try:
            if await self._store.in_order(self._promoted_by_policy, new):
                self._tell_promoted(new, "policy")
        except CellctlError as error:
            log.warning("not promoted", calibration=new, error=error.message)

    def _promoted_by_policy(self, new: str) -> bool:
        """In the store's thread, so that no other promotion comes in between."""
        store = self._store.calibrations
        active = store.info(store.active).document if store.active else None
        if not self._promotes(store.info(new).document, active):
            return False
        store.promote(new, "policy", despite_failed_verdict=False)
        return True

    def _info(self, folder: RunFolder) -> RunInfo:
        info = folder.info()
        if self._active is None or self._active.run_id != info.run_id:
            return info
        return info.model_copy(update={"progress": self._active.progress or info.progress})

    def _procedure(self, name: str) -> Procedure:
        if name not in self._procedures:
            known = list(self._procedures)
            raise NotFound(f"no procedure {name!r}; there are: {', '.join(known)}", known=known)
        return self._procedures[name]

    def _replayed(self, folder: RunFolder, name: str, params: Mapping[str, Any]) -> RunAccepted:
        header = folder.header
        if (header.procedure, header.params) != (name, params):
            raise BadInput(
                f"request_id {header.request_id!r} started run {header.run_id} of "
                f"{header.procedure} with other parameters; use a new one",
                run_id=header.run_id,
            )
        return RunAccepted(run_id=header.run_id, boot=self.boot, replayed=True)

    def _require_free_and_permitted(self, procedure: Procedure) -> None:
        if self._closing:
            raise Busy("the daemon is shutting down")
        if (active := self._active) is not None:
            raise Busy(
                f"run {active.run_id} of {active.procedure.name} owns the cell; wait for its end "
                "or cancel it",
                active_run=active.run_id,
            )
        if self._fault is not None:
            raise DeviceFault(f"{self._fault}. When it is put right: `cellctl ack`")
        if procedure.moves:
            self._gate.permission.require()

    async def _abandon(self, run_id: str, client: str) -> Accepted:
        status = self._store.folder(run_id).standing.status
        if status == "interrupted":
            await self._store.note(run_id, "abandoned", error=f"abandoned by {client}")
            self._bulletin.event("ended", run_id, status="abandoned")
            return Accepted(message="the run is abandoned", run_id=run_id)
        if status in ("cancelled", "abandoned"):
            return Accepted(message=f"the run is {status} already", run_id=run_id)
        raise BadInput(f"run {run_id} is {status}; there is nothing to cancel")

    def _unacknowledged(self) -> dict[str, str]:
        found = ((f.header.run_id, f.standing.fault) for f in self._store.folders())
        return {run_id: fault for run_id, fault in found if fault}

    async def _acknowledge(self, client: str) -> Accepted:
        if self._hung is not None and not self._hung.done():
            raise DeviceFault(f"{self._fault}; it cannot be acknowledged before that")
        for run_id in self._unacknowledged():
            await self._store.note(run_id, "acknowledged", client=client)
        self._fault = None
        self._fire("ack")
        self._bulletin.event("acknowledged", client=client)
        return Accepted(message="the fault is acknowledged")

    async def _promote(self, calibration_id: str, client: str, **options: bool) -> None:
        promote = self._store.calibrations.promote
        await self._store.in_order(promote, calibration_id, client, **options)
        self._tell_promoted(calibration_id, client)

    def _tell_promoted(self, calibration_id: str, client: str) -> None:
        self._bulletin.event("promoted", calibration_id=calibration_id, client=client)
        self._tell_state()
