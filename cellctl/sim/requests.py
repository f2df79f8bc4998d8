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


class RobotDraw(Sampled):
    """Start to follow joint rows (rad) without stopping, with the tip at `speed_m_s`."""

    joints: Annotated[list[Joints], Field(min_length=1, max_length=5000)]
    speed_m_s: Annotated[float, Field(gt=0, le=1.0)]
    joint_speed_rad_s: Positive
    joint_acceleration_rad_s2: Positive


class RobotTouch(RobotDraw):
    """As `robot.draw`, until the pen feels a contact."""


class RobotFollowed(Request):
    """What was measured during the last stroke or touch, at 125 Hz. The reply's blob are rows of
    seven float64: t, joints."""


class RobotFelt(Request):
    """The state at which the last touch felt its contact; `felt` is null when it has not."""


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


Millimetres = Annotated[float, Field(ge=-1000, le=1000)]
Shift = tuple[Millimetres, Millimetres, Millimetres]
Metres = Annotated[float, Field(ge=-10, le=10)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Name = Annotated[str, Field(min_length=1, max_length=32)]
Strokes = Annotated[int, Field(ge=0, le=1_000_000)]
Share = Annotated[float, Field(ge=0, le=1)]


class Later(Request):
    """It happens when `after_strokes` strokes have been drawn since the world began (touches do
    not count), at once if they have: before the next motion that begins with the pen in the air,
    and before the next stroke."""

    after_strokes: Strokes = 0


class PenSlip(Later):
    """The pen slips in its holder, for good, by mm in the flange frame."""

    shift_mm: Shift


class PenDry(Later):
    """No ink from then on."""


class PenWeak(Later):
    """In `count` strokes, ink for the first `share` of the way that the pen is down."""

    share: Share
    count: int = Field(default=1, ge=0, le=100_000)


class PenOff(Request):
    """From now on the pen is mounted off, by mm in the flange frame."""

    shift_mm: Shift


class Shrink(Later):
    """Circles come out with `factor` times the commanded radius; 1 heals it."""

    factor: float = Field(ge=0.1, le=2.0)


class SheetMove(Later):
    """A sheet is shifted by mm along the world's axes and turned about its middle."""

    sheet: Name
    shift_mm: tuple[Millimetres, Millimetres] = (0.0, 0.0)
    turn_deg: Degrees = 0.0


class SheetReplace(Later):
    """A person lays fresh paper; `sheet` null: all sheets."""

    sheet: Name | None = None


class SheetPrint(Later):
    """A person lays a form with print on it: frame, grid, circles, marks like text."""

    sheet: Name


class PendantJog(Request):
    """A person moves the arm straight to joints (rad); answered when it stands there."""

    joints: Joints


class PendantPlace(Request):
    """A person moves the arm until the true pen tip stands on a world point (m), with the flange
    at that orientation (rpy about the fixed axes); answered when it stands there."""

    point: tuple[Metres, Metres, Metres]
    rpy_deg: tuple[Degrees, Degrees, Degrees]
