"""The fixed numbers of the simulated cells. A test pins them; nobody makes them kinder.

Angles are in degrees and lengths in metres unless a name says otherwise. `*_sigma` is one
standard deviation of a normal distribution, `*_off` a magnitude whose sign the seed draws.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ArmErrors:
    """How the true arm differs from its reported kinematics, and how it repeats."""

    zero_sigma_deg: float
    length_sigma_m: float
    twist_sigma_deg: float
    repeat_sigma_m: float = 0.058e-3
    repeat_sigma_deg: float = 0.02
    drawing_repeat_sigma_deg: float = 0.01


@dataclass(frozen=True)
class CameraPreset:
    """The true camera: `focal_px`, `centre_px` +- `pixel_sigma`, k1 and k2 +- 10 %."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    height_m: float
    tilt_deg: tuple[float, float]
    yaw_deg: float
    factory_centre_off_px: float
    pixel_sigma: float = 3.0
    distortion: tuple[float, float, float, float, float] = (0.085, -0.060, 0.0005, -0.0004, 0.012)
    radial_spread: float = 0.10
    tilt_sigma_deg: float = 1.0
    aim_sigma_m: float = 0.020
    factory_focal_off: float = 0.003
    factory_distortion_factor: float = 0.9
    frame_rate_hz: float = 30.0
    exposure_s: float = 0.0167
    delivery_s: float = 0.060
    buffers: int = 4
    noise_sigma: float = 2.0
    defocus_px: float = 0.7
    unevenness: float = 0.30


@dataclass(frozen=True)
class ProjectorPreset:
    """The true projector; its principal point lies below its image (lens shift)."""

    throw_ratio: float
    distance_m: float
    yaw_deg: float
    size_px: tuple[int, int] = (1920, 1080)
    tilt_deg: tuple[float, float] = (3.0, 2.0)
    tilt_sigma_deg: float = 1.0
    centre_px: tuple[float, float] = (960.0, 1134.0)
    centre_sigma_px: tuple[float, float] = (6.0, 8.0)
    distortion: tuple[float, float] = (0.02, -0.004)
    latency_s: float = 0.035
    latency_sigma_s: float = 0.008


@dataclass(frozen=True)
class PenPreset:
    """The pen in its sprung holder: how far it gives way and how wide it writes. A touch is felt
    when it is pushed in by `felt_m` +- `felt_sigma_m`; an operator's eye is good to
    `eye_sigma_m`."""

    travel_m: float = 5.0e-3
    line_m: float = 0.8e-3
    felt_m: float = 0.2e-3
    felt_sigma_m: float = 0.03e-3
    eye_sigma_m: float = 0.1e-3


@dataclass(frozen=True)
class TablePreset:
    """The table: centre of the lit area, the area on it that is drawn in, and the table top
    around the same centre (all extents along the world's x and y). Paper lies on the drawn area
    and `sheet_margin_m` around it."""

    centre_m: tuple[float, float, float]
    area_m: tuple[float, float]
    top_m: tuple[float, float]
    tilt_sigma_rad: float = 1.5e-3
    bow_m: float = 1.0e-3
    bow_off_centre: float = 0.15
    touched_height_off_m: float = 0.3e-3
    sheet_margin_m: float = 0.040


@dataclass(frozen=True)
class BoardPreset:
    """Board sizes: inner corners and square of the checkerboard; markers, side and pitch. The
    bracket: boards `clearance_m` beside and `tray_m` before the flange, the pen's length. They
    face backwards, up while the pen points down, or `forwards`, as the pen points: an arm whose
    forearm comes from below shows them so to a camera high above it."""

    inner_corners: tuple[int, int]
    square_m: float
    markers: tuple[int, int]
    marker_m: float
    pitch_m: float
    clearance_m: float
    tray_m: float
    pen_m: float
    forwards: bool = False
    dictionary: str = "DICT_4X4_50"
    scale_off: tuple[float, float] = (0.001, 0.005)
    bend_m: float = 0.3e-3


@dataclass(frozen=True)
class SpeedPreset:
    """What the config caps motions at; nobody is near."""

    joint_deg_s: float = 40.0
    joint_deg_s2: float = 80.0
    tcp_m_s: float = 0.5


@dataclass(frozen=True)
class FencePreset:
    """Where the arm may be, corners in the world, when camera and projector hang from the
    ceiling; without a fence they are on a mast at the table's far edge."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]


@dataclass(frozen=True)
class Preset:
    name: str
    arm: str
    arm_errors: ArmErrors
    camera: CameraPreset
    projector: ProjectorPreset
    table: TablePreset
    boards: BoardPreset
    home_deg: tuple[float, float, float, float, float, float]
    pen: PenPreset = PenPreset()
    pen_sigma_m: float = 0.5e-3
    pen_slip_sigma_m: float = 0.15e-3
    tape_off_m: float = 0.10
    tape_off_deg: float = 10.0
    speeds: SpeedPreset = SpeedPreset()
    fence: FencePreset | None = None
    body_radius_m: float = 0.05
    """Camera and projector are bodies of this radius around their optical centres."""


CR = Preset(
    name="cr",
    arm="ur5",
    arm_errors=ArmErrors(zero_sigma_deg=0.03, length_sigma_m=0.15e-3, twist_sigma_deg=0.01),
    camera=CameraPreset(
        size_px=(1920, 1080),
        focal_px=(915.0, 914.0),
        centre_px=(958.0, 548.0),
        height_m=0.8,
        tilt_deg=(4.0, -3.0),
        yaw_deg=0.0,
        factory_centre_off_px=2.0,
    ),
    home_deg=(-190.0, -95.0, -70.0, -105.0, 90.0, -100.0),
    projector=ProjectorPreset(throw_ratio=1.55, distance_m=1.3, yaw_deg=0.0),
    table=TablePreset(centre_m=(0.0, -0.44, 0.0), area_m=(0.670, 0.375), top_m=(1.70, 1.10)),
    boards=BoardPreset(
        inner_corners=(9, 6),
        square_m=0.030,
        markers=(3, 4),
        marker_m=0.050,
        pitch_m=0.060,
        clearance_m=0.09,
        tray_m=0.08,
        pen_m=0.18,
    ),
)

IR = Preset(
    name="ir",
    arm="irb4600-60/2.05",
    arm_errors=ArmErrors(zero_sigma_deg=0.02, length_sigma_m=0.25e-3, twist_sigma_deg=0.01),
    camera=CameraPreset(
        size_px=(3840, 2160),
        focal_px=(1830.0, 1828.0),
        centre_px=(1916.0, 1096.0),
        height_m=4.0,
        tilt_deg=(6.0, 4.0),
        yaw_deg=90.0,
        factory_centre_off_px=4.0,
        pixel_sigma=6.0,
    ),
    home_deg=(90.0, 0.0, 20.0, 0.0, 70.0, 0.0),
    projector=ProjectorPreset(throw_ratio=1.40, distance_m=3.3, yaw_deg=90.0),
    table=TablePreset(centre_m=(1.3, 0.0, 0.6), area_m=(0.750, 1.100), top_m=(1.50, 2.60)),
    boards=BoardPreset(
        inner_corners=(9, 6),
        square_m=0.060,
        markers=(3, 5),
        marker_m=0.080,
        pitch_m=0.100,
        clearance_m=0.10,
        tray_m=0.20,
        pen_m=0.30,
        forwards=True,
        dictionary="DICT_5X5_50",  # the camera sees the parked board beside the projected markers
    ),
    pen=PenPreset(line_m=2.0e-3),
    speeds=SpeedPreset(joint_deg_s=60.0, joint_deg_s2=120.0, tcp_m_s=1.5),
    fence=FencePreset(low_m=(-1.6, -2.2, 0.0), high_m=(2.5, 2.2, 2.4)),
)

PRESETS = {preset.name: preset for preset in (CR, IR)}
