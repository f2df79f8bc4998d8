"""What a person writes: one TOML file a cell. Unknown keys are errors; units are in the names.

Poses that a person measured with a tape are `position_m` and `rpy_deg` (roll, pitch, yaw about
the fixed x, y, z axes, REP-103). They only have to be right within `[tape]`.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from cellctl.arms import arm
from cellctl.calib.targets import board_from_dict
from cellctl.errors import BadInput
from cellctl.explain import explain
from cellctl.geometry import Transform
from cellctl.local import DEFAULT_ENDPOINT

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Pixels = tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]]

LOOPBACK = re.compile(r"tcp/(127(\.\d{1,3}){3}|localhost|\[::1\]):\d{1,5}")


def _explained(check: Callable[..., object], *args: Any) -> None:
    """Run a check that raises BadInput where pydantic wants a ValueError, which it then places."""
    try:
        check(*args)
    except BadInput as error:
        raise ValueError(error.message) from None


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Pose(Section):
    """A tape-measured pose."""

    position_m: Vector
    rpy_deg: Vector

    def transform(self, parent: str, child: str) -> Transform:
        return Transform.from_rpy_deg(parent, child, self.rpy_deg, self.position_m)


class CellSection(Section):
    """`motion_enabled` replaces `cellctl enable`; only a simulated cell may set it."""

    id: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")
    data_dir: str = "~/.local/share/cellctl"
    motion_enabled: bool = False

    @field_validator("data_dir")
    @classmethod
    def _absolute(cls, value: str) -> str:
        if not Path(value).expanduser().is_absolute():
            raise ValueError(
                f"{value!r} would be another folder for each program; write it from / or ~"
            )
        return value


class BusSection(Section):
    listen: str = DEFAULT_ENDPOINT

    @field_validator("listen")
    @classmethod
    def _loopback(cls, value: str) -> str:
        if not LOOPBACK.fullmatch(value):
            raise ValueError(
                f"{value!r} is not tcp/HOST:PORT with a loopback host (127.0.0.1, localhost, [::1])"
            )
        return value


class SimulationSection(Section):
    """The simulated world behind the `sim` drivers."""

    preset: str
    seed: int = Field(default=0, ge=0)
    time: Literal["stepped", "paced"] = "stepped"
    idle_exit_s: Positive = 1800.0


class TapeSection(Section):
    """How far the tape-measured poses may be off; the guard and the search allow for it."""

    position_m: Positive = 0.10
    angle_deg: Positive = 10.0


class RobotSection(Section):
    """Speeds at 100 %: caps of every motion, whatever a procedure asks for."""

    driver: Literal["sim"]
    arm: str
    joint_speed_deg_s: Positive = 40.0
    joint_acceleration_deg_s2: Positive = 80.0
    tcp_speed_m_s: Positive = 0.5

    @field_validator("arm")
    @classmethod
    def _known_arm(cls, value: str) -> str:
        _explained(arm, value)
        return value


class FactoryCamera(Section):
    """The maker's intrinsics, in pixels; `distortion` in OpenCV's order k1 k2 p1 p2 k3."""

    focal_px: tuple[Positive, Positive]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class CameraSection(Section):
    driver: Literal["sim"]
    image_size_px: Pixels
    factory: FactoryCamera
    pose: Pose


class ProjectorSection(Section):
    """`centre_px` is the principal point that throw and lens shift of the data sheet give; it
    may lie outside the image. `latency_s` is display to glass, margin included."""

    driver: Literal["sim"]
    size_px: Pixels
    throw_ratio: Positive
    centre_px: tuple[float, float]
    latency_s: float = Field(ge=0, lt=2)
    pose: Pose


class Rectangle(Section):
    """A rectangle on the table, along the world's x and y."""

    min_m: tuple[float, float]
    max_m: tuple[float, float]

    @model_validator(mode="after")
    def _ordered(self) -> Rectangle:
        if not np.all(np.array(self.min_m) < np.array(self.max_m)):
            raise ValueError("min_m must be below max_m in x and y")
        return self


class SheetSection(Rectangle):
    """Paper on the table, where the pen may be down. Its used spots are kept by its name."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")


class TableSection(Section):
    """`pose`: centre of the lit area, z up. `touched_height_m`: the table's height in the world
    frame as the robot knows it, from touching it. `area_m`: what is calibrated and drawn in.
    `top`: the table's edges; without it the table has none, and the arm stays above its height."""

    pose: Pose
    touched_height_m: float
    area_m: tuple[Positive, Positive]
    top: Rectangle | None = None


class Box(Section):
    """A box along the axes of its frame."""

    min_m: Vector
    max_m: Vector

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if not np.all(np.array(self.min_m) < np.array(self.max_m)):
            raise ValueError("min_m must be below max_m in x, y and z")
        return self


class BoardMount(Section):
    """A board on the bracket. `board` is written as in a data set; `pose` is T_flange_board, by
    tape. The hull is a box in the flange frame that surely contains the board and its holder:
    the guard trusts it, so it comes from the drawing or a ruler and is rounded up."""

    board: dict[str, Any]
    pose: Pose
    hull: Box

    @field_validator("board")
    @classmethod
    def _known_board(cls, value: dict[str, Any]) -> dict[str, Any]:
        _explained(board_from_dict, value, "board")
        return value


class PenMount(Section):
    """The pen on the flange: `tip_m` as far as known, and the radius of its hull. Its holder gives
    way by `travel_m` along the flange's z, and `feels_contact` if arm or holder can. `line_m` is
    the width of the line that it draws. `posture_deg` are joints with the pen upright about over
    the middle of the table: which branch of the arm draws, and which way round the tool then is.
    World points are meant for that posture; without it, it is found from where the arm stands."""

    tip_m: Vector
    radius_m: Positive
    travel_m: Positive = 0.005
    line_m: Positive = 0.001
    feels_contact: bool = False
    posture_deg: tuple[float, float, float, float, float, float] | None = None


class BracketSection(Section):
    """Carries the boards and the pen, so that nothing is changed by hand."""

    checkerboard: BoardMount
    markers: BoardMount
    pen: PenMount


class NamedBox(Box):
    name: str


class WorkspaceSection(Section):
    """Where the arm and all that it carries may be. `clearance_m` is kept from the table, the walls
    and the keep-outs, and is three times what lies between two checked states of a path; between
    links and boards their hulls are all that is kept. `device_radius_m` around camera and
    projector."""

    box: Box
    keep_outs: tuple[NamedBox, ...] = ()
    clearance_m: float = Field(default=0.03, ge=0.03)
    device_radius_m: Positive = 0.12
    joint_margin_deg: float = Field(default=5.0, ge=0, lt=90)


class PromotionSection(Section):
    """When a calibration becomes the active one. "manual": when a person says so (`cellctl
    promote`). "not-worse": also by itself, when it has passed and was measured to be no worse than
    the active one."""

    policy: Literal["manual", "not-worse"] = "manual"


class CellConfig(Section):
    """One workcell."""

    config_version: Literal[1]
    cell: CellSection
    bus: BusSection = BusSection()
    simulation: SimulationSection | None = None
    tape: TapeSection = TapeSection()
    robot: RobotSection
    camera: CameraSection
    projector: ProjectorSection
    table: TableSection
    sheets: tuple[SheetSection, ...] = ()
    bracket: BracketSection
    workspace: WorkspaceSection
    promotion: PromotionSection = PromotionSection()

    @model_validator(mode="after")
    def _only_simulations_are_enabled(self) -> CellConfig:
        if self.simulation is None:
            if self.cell.motion_enabled:
                raise ValueError("cell.motion_enabled: only a cell with [simulation] may set it")
            if "sim" in (self.robot.driver, self.camera.driver, self.projector.driver):
                raise ValueError('driver "sim" needs a [simulation] section')
        return self

    @field_validator("sheets")
    @classmethod
    def _named_once(cls, value: tuple[SheetSection, ...]) -> tuple[SheetSection, ...]:
        names = [sheet.name for sheet in value]
        if len(set(names)) < len(names):
            raise ValueError("every sheet needs a name of its own")
        return value

    def data_dir(self) -> Path:
        """Where this cell keeps its runs; CELLCTL_DATA wins over the file."""
        return Path(os.environ.get("CELLCTL_DATA") or self.cell.data_dir).expanduser()


def load_config(path: Path) -> CellConfig:
    """Read a cell's TOML. BadInput names file, key and, for an unknown key, the nearest one."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read: {error}") from None
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise BadInput(f"{path}: nested too deeply") from None
    return parse_config(document, str(path))


def parse_config(document: dict[str, Any], where: str) -> CellConfig:
    """As `load_config`, from a document already read; `where` is named in errors."""
    try:
        return CellConfig.model_validate(document)
    except ValidationError as error:
        raise BadInput(f"{where}: {explain(error, CellConfig)}") from None
