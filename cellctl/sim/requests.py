"""The requests that the simulated cell's doors understand; anything else is an error reply."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Joints = tuple[float, float, float, float, float, float]
Vector = tuple[float, float, float]
Pixel = tuple[float, float]
Positive = Annotated[float, Field(gt=0, le=1e4)]
Seconds = Annotated[float, Field(ge=0, le=3600)]


class Request(BaseModel):
    """Base of all requests; `id` comes back with the reply."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    id: int = Field(ge=0)
    verb: str


class Sample(BaseModel):
    """The sample that is being taken, and how many such requests were made in it before."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str = Field(min_length=1, max_length=200)
    count: int = Field(ge=0)

    def key(self) -> str:
        return f"{self.name}#{self.count}"


class Sampled(Request):
    sample: Sample | None = None

    def key(self) -> str | None:
        return self.sample.key() if self.sample else None


class Hello(Request):
    """What this cell is. The reply has `preset`, `seed`, `time`, `arm` and the image sizes."""


class Wait(Request):
    """Let `seconds` of cell time pass."""

    seconds: Seconds


class RobotRead(Request):
    """The newest measured state."""


class RobotReadAt(Request):
    """The measured state at cell time `at`."""

    at: float


class RobotCheck(Request):
    """Whether the controller would follow these waypoints."""

    waypoints: Annotated[list[Joints], Field(min_length=1, max_length=2000)]


class RobotMove(Sampled):
    """Start to follow waypoints (rad) under these limits; the reply comes at once."""

    waypoints: Annotated[list[Joints], Field(min_length=1, max_length=2000)]
    joint_speed_rad_s: Positive
    joint_acceleration_rad_s2: Positive
    tool_speed_m_s: Positive


class RobotStop(Request):
    """Start to brake; `hard`: as hard as the arm can."""

    hard: bool = False


class RobotWait(Request):
    """Wait until the arm is not commanded to move and all measured joint speeds have been zero
    for `standstill_s`, or `timeout_s` of cell time have passed."""

    standstill_s: Seconds
    timeout_s: Seconds


class CameraDequeue(Request):
    """The oldest delivered frame; waits up to `timeout_s` for one. `frame` is null without."""

    timeout_s: Seconds


class CameraPicture(Sampled):
    """The picture of the frame that this connection dequeued last."""


class ProjectorShow(Sampled):
    """Show the blob: an image of `shape` (height, width) or (height, width, 3), uint8."""

    shape: tuple[int, int] | tuple[int, int, Literal[3]]


class Score(Request):
    """`true_mm` and `true_px` of the projector pixels sent for the scoring grid's points."""

    pixels: Annotated[list[Pixel], Field(min_length=1, max_length=1000)]


class Nothing(Request):
    """A request without arguments."""


class Nudge(Request):
    """Move a device, in its own optical frame."""

    device: Literal["camera", "projector"]
    shift_mm: Vector = (0.0, 0.0, 0.0)
    turn_deg: Vector = (0.0, 0.0, 0.0)


class ProtectiveStop(Request):
    reason: str = Field(default="planted", max_length=200)


class Freeze(Request):
    """The camera repeats its present picture for `seconds`."""

    seconds: Seconds


class Drop(Request):
    """The next `frames` frames are lost."""

    frames: int = Field(ge=0, le=100_000)


class Slow(Request):
    """The next `count` replies of the cell's door come `seconds` (real time) late."""

    seconds: Seconds
    count: int = Field(ge=0, le=100_000)
