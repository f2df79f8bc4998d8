"""What travels over the bus: versioned models. Readers ignore unknown fields of newer peers."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cellctl.errors import printable

RunStatus = Literal["running", "waiting", "interrupted", "done", "failed", "cancelled", "abandoned"]
Verdict = Literal["pass", "fail"]
Phase = Literal["idle", "running", "waiting", "stopping", "fault"]

SCHEMA_PREFIX = "cellctl"


class Message(BaseModel):
    """Base of all messages; `v` is the version of the schema `cellctl.<Name>.v<N>`."""

    # Built when first used: a command uses two of them, and starts 70 ms sooner.
    model_config = ConfigDict(extra="ignore", ser_json_inf_nan="null", defer_build=True)
    VERSION: ClassVar[int] = 1
    v: Literal[1] = 1

    @model_validator(mode="before")
    @classmethod
    def _can_be_sent(cls, fields: Any) -> Any:
        return printable(fields)

    @classmethod
    def schema_name(cls) -> str:
        return f"{SCHEMA_PREFIX}.{cls.__name__}.v{cls.VERSION}"


class Command(Message):
    """A command; `client` is an audit label, not an identity."""

    client: str = Field(default="?", max_length=64)


class RunRequest(Command):
    """`request_id` makes a trigger idempotent, also over a restart of the daemon.

    `speed` is the percentage of the configured speed; `step` asks before every motion.
    """

    request_id: str = Field(min_length=8, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")
    params: dict[str, Any] = {}
    speed: float = Field(default=100.0, gt=0.0, le=100.0)
    step: bool = False


class RunAccepted(Message):
    run_id: str
    boot: str
    replayed: bool = False


class ResumeRequest(Command):
    run_id: str


class CancelRequest(Command):
    """Cancels the active run, or abandons an interrupted one. None means the active run."""

    run_id: str | None = None


class AckRequest(Command):
    """Acknowledges a fault, or answers the operator question of a waiting run.

    `question` is the id of the question that is answered: with it, an answer that comes late is
    refused instead of being taken for another question's, or for a fault's acknowledgement. It may
    be left out only where the question has a single answer.
    """

    answer: str = Field(default="ok", max_length=1000)
    question: int | None = None


class PromoteRequest(Command):
    """Makes a calibration the active one; one that failed its verdict only if that is said."""

    calibration_id: str
    despite_failed_verdict: bool = False


class Accepted(Message):
    """A command was accepted; `message` says what follows."""

    message: str = ""
    run_id: str | None = None


class Error(Message):
    """Sent through `reply_err`; `code` is one of `cellctl.errors.BY_CODE`."""

    code: str
    message: str
    details: dict[str, Any] = {}


class Question(Message):
    """What a waiting run asks its operator; `id` is the number of its journal line."""

    id: int = 0
    text: str
    choices: list[str] = ["ok"]


class Progress(Message):
    run_id: str
    step: str
    done: int
    total: int
    text: str = ""


class RobotSnapshot(Message):
    """`joints` rad; `position` metres and `rvec` rad of the flange in the world frame."""

    t: float
    joints: list[float]
    position: list[float]
    rvec: list[float]
    standstill_s: float


class State(Message):
    """An immutable snapshot of the daemon, as of event `seq`.

    `enabled`: motion is permitted, until `enabled_until` (wall clock, s; None: without end). When
    it is not, `enable_command` is what to type on the cell's machine.
    """

    cell: str
    boot: str
    seq: int
    phase: Phase
    active_run: str | None = None
    procedure: str | None = None
    question: Question | None = None
    fault: str | None = None
    progress: Progress | None = None
    active_calibration: str | None = None
    enabled: bool = False
    enabled_until: float | None = None
    enable_command: str | None = None
    simulated: bool = False
    wall_time: float


class Event(Message):
    """Something happened; `seq` grows by one within a `boot`."""

    boot: str
    seq: int
    kind: str
    wall_time: float
    run_id: str | None = None
    data: dict[str, Any] = {}


class Events(Message):
    boot: str
    events: list[Event]


class RunInfo(Message):
    """A run as the store knows it."""

    run_id: str
    procedure: str
    status: RunStatus
    verdict: Verdict | None = None
    reasons: list[str] = []
    error: str | None = None
    samples: int = 0
    started: str
    ended: str | None = None
    params: dict[str, Any] = {}
    progress: Progress | None = None
    question: Question | None = None
    calibration_id: str | None = None
    directory: str = ""
    report: str | None = None
    result: dict[str, Any] | None = None


class Runs(Message):
    runs: list[RunInfo]


class CalibrationInfo(Message):
    calibration_id: str
    active: bool
    document: dict[str, Any]


class ProcedureInfo(Message):
    name: str
    summary: str
    moves: bool
    params: dict[str, Any]


class Procedures(Message):
    procedures: list[ProcedureInfo]
