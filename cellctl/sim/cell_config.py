"""The config of a simulated cell, as the person who set it up would have written it.

Poses are tape-measured: off from the truth by up to the preset's 10 cm and 10 degrees, and
written as a person writes, in millimetres and tenths of degrees. The camera's factory values are
off, too. What the guard trusts (hulls, touched height) is right, and hulls are rounded up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.geometry import Array
from cellctl.sim.bodies import plate_points, sheet
from cellctl.sim.grid import drawing_joints, touched_height
from cellctl.sim.presets import Preset, SpeedPreset
from cellctl.sim.textures import description
from cellctl.sim.truth import STREAMS, Truth, draw, scoring_grid, sheet_rectangle, tape_error

HULL_MARGIN_M, HULL_DEPTH_M = 0.02, 0.02
LATENCY_SIGMAS = 6.0
MAST_M = (0.20, 0.08, 1.6)
"""Width, depth and height of the mast at the table's far edge, for camera and projector."""

COMMENTS = {
    "": """A simulated cell that runs as it is: `cellctl serve {path}`.
Made by `python -m cellctl.sim config --cell {preset} --seed {seed}`; the truth behind it is
drawn by the seed. Lengths are in metres, angles in degrees, frames as in docs/conventions.""",
    "cell": "Motion needs no `cellctl enable`: nobody can be hurt in here.",
    "simulation": """The world behind the "sim" drivers. "stepped": time passes only while the
cell waits for something, so that a seed gives the same run on any machine; "paced": real time.""",
    "tape": "How far the poses below may be off. The search and the guard allow for it.",
    "robot": "Speeds at 100 %: caps of every motion, whatever a procedure asks for.",
    "camera": "The pose is that of the optical frame: x right, y down, z into the picture.",
    "camera.factory": "The maker's intrinsics; the baseline that calibration has to beat.",
    "projector": """centre_px is the principal point: with lens shift it lies outside the image.
latency_s is display to glass, margin included.""",
    "table": """pose: middle of the lit area, z up. touched_height_m: the table's height in the
world frame, from touching it with the pen. area_m: what is calibrated and drawn in (x, y).""",
    "bracket.checkerboard": """One bracket on the flange carries both boards and the pen. pose is
T_flange_board, by tape. The hull is in the flange frame and surely contains board and holder.""",
    "sheets": """Paper on the table, along the world's x and y: where the pen may be down.""",
    "bracket.pen": """tip_m: in the flange frame, as far as known. Its holder gives way by travel_m
along the flange's z. line_m: width of the line that it draws.""",
    "workspace": """Where the arm and all that it carries may be. clearance_m is kept from the
table and the keep-outs, device_radius_m around camera and projector.""",
}
"""Printed above the table of that name."""


def cell_document(preset: Preset, seed: int) -> dict[str, Any]:
    """The config of the cell that `seed` draws from `preset`, as `cellctl.config` parses it."""
    truth = draw(preset, seed)
    rng = np.random.default_rng([seed, STREAMS.index("tape")])
    boards = truth.boards
    taped = {
        name: _taped(preset, pose.matrix, rng)
        for name, pose in (
            ("camera", truth.camera.pose),
            ("projector", truth.projector.pose),
            ("table", truth.table.pose),
            ("checkerboard", boards["checkerboard"].pose),
            ("markers", boards["markers"].pose),
        )
    }
    height = touched_height(truth)
    return {
        "config_version": 1,
        "cell": {
            "id": f"sim-{preset.name}",
            "data_dir": f"~/.local/share/cellctl/sim-{preset.name}",
            "motion_enabled": True,
        },
        "simulation": {"preset": preset.name, "seed": seed, "time": "stepped"},
        "tape": {"position_m": preset.tape_off_m, "angle_deg": preset.tape_off_deg},
        "robot": {"driver": "sim", "arm": preset.arm, **_speeds(preset.speeds)},
        "camera": _camera(truth, rng) | {"pose": taped["camera"]},
        "projector": _projector(preset) | {"pose": taped["projector"]},
        "table": _table(preset, height) | {"pose": taped["table"]},
        "sheets": [_sheet(preset)],
        "bracket": {
            **{name: _mount(truth, name, taped[name]) for name in boards},
            "pen": _pen(truth),
        },
        "workspace": _workspace(truth, height),
    }


def _taped(preset: Preset, pose: Array, rng: np.random.Generator) -> dict[str, list[float]]:
    """A pose as `[*.pose]`, off by the tape's error and by rounding."""
    off = tape_error(preset, pose, rng)
    rpy = Rotation.from_matrix(off[:3, :3]).as_euler("xyz", degrees=True)
    return {"position_m": _rounded(off[:3, 3], 3), "rpy_deg": _rounded(rpy, 1)}


def _camera(truth: Truth, rng: np.random.Generator) -> dict[str, Any]:
    preset, lens = truth.preset.camera, truth.camera.lens
    focal = lens.focal * (1 + preset.factory_focal_off * rng.choice((-1.0, 1.0)))
    centre = lens.centre + preset.factory_centre_off_px * rng.choice((-1.0, 1.0), 2)
    factory = {
        "focal_px": _rounded(focal, 2),
        "centre_px": _rounded(centre, 2),
        "distortion": _rounded(lens.distortion * preset.factory_distortion_factor, 6),
    }
    return {"driver": "sim", "image_size_px": list(preset.size_px), "factory": factory}


def _speeds(speeds: SpeedPreset) -> dict[str, float]:
    return {
        "joint_speed_deg_s": speeds.joint_deg_s,
        "joint_acceleration_deg_s2": speeds.joint_deg_s2,
        "tcp_speed_m_s": speeds.tcp_m_s,
    }


def _table(preset: Preset, height: float) -> dict[str, Any]:
    table = {"touched_height_m": round(height, 5), "area_m": list(preset.table.area_m)}
    if preset.table.centre_m[2] <= 0.0:
        return table
    centre, half = np.array(preset.table.centre_m[:2]), np.array(preset.table.top_m) / 2
    corners = {"min_m": _rounded(centre - half, 2), "max_m": _rounded(centre + half, 2)}
    return table | {"top": corners}


def _sheet(preset: Preset) -> dict[str, Any]:
    low, high = sheet_rectangle(preset)
    return {"name": "A", "min_m": _rounded(low, 4), "max_m": _rounded(high, 4)}


def _pen(truth: Truth) -> dict[str, Any]:
    return {
        "tip_m": truth.nominal_pen.tolist(),
        "radius_m": 0.01,
        "travel_m": truth.preset.pen.travel_m,
        "line_m": truth.preset.pen.line_m,
        "feels_contact": True,
        "posture_deg": _rounded(np.degrees(_drawing_posture(truth)), 1),
    }


def _projector(preset: Preset) -> dict[str, Any]:
    projector = preset.projector
    latency = projector.latency_s + LATENCY_SIGMAS * projector.latency_sigma_s
    return {
        "driver": "sim",
        "size_px": list(projector.size_px),
        "throw_ratio": projector.throw_ratio,
        "centre_px": list(projector.centre_px),
        "latency_s": round(latency, 3),
    }


def _drawing_posture(truth: Truth) -> Array:
    """Joints (6,) with the pen over the middle of the table, on the branch that draws: that on
    which all of the area can be reached."""
    grid = scoring_grid(truth.preset)
    return drawing_joints(truth, grid, touched_height(truth))[len(grid) // 2]


def _mount(truth: Truth, name: str, pose: dict[str, list[float]]) -> dict[str, Any]:
    """A board; its hull reaches over to the flange's axis, as the tray does, and is as wide as
    the wider of both."""
    sheets = {n: plate_points(sheet(b, truth), spacing=10.0) for n, b in truth.boards.items()}
    mine, both = sheets[name], np.concatenate(list(sheets.values()))
    low = np.array([min(mine[:, 0].min(), 0.0), both[:, 1].min(), both[:, 2].min()])
    high = np.array([max(mine[:, 0].max(), 0.0), both[:, 1].max(), both[:, 2].max()])
    around = np.array([HULL_MARGIN_M, HULL_MARGIN_M, HULL_DEPTH_M])
    return {
        "board": description(name, truth.preset.boards),
        "pose": pose,
        "hull": {"min_m": _outwards(low - around, -1), "max_m": _outwards(high + around, 1)},
    }


def _workspace(truth: Truth, height: float) -> dict[str, Any]:
    fence = truth.preset.fence
    low, high, keep_outs = _before_mast(truth, height)
    if fence is not None:
        low, high, keep_outs = np.array(fence.low_m), np.array(fence.high_m), []
    return {
        "clearance_m": 0.03,
        "device_radius_m": 0.12,
        "joint_margin_deg": 5.0,
        "box": {"min_m": _rounded(low, 2), "max_m": _rounded(high, 2)},
        "keep_outs": keep_outs,
    }


def _before_mast(truth: Truth, height: float) -> tuple[Array, Array, list[dict[str, Any]]]:
    """The arm's reach, but not beyond the table on the side away from its base, and the mast."""
    preset, model = truth.preset, truth.nominal_arm
    reach = float(np.abs(model.a).sum() + np.abs(model.d).sum()) + preset.boards.pen_m
    low, high = np.array([-reach, -reach, min(height, 0.0) - 0.05]), np.full(3, reach)
    centre, top = np.array(preset.table.centre_m[:2]), np.array(preset.table.top_m)
    axis = int(np.argmax(np.abs(centre)))
    far = centre[axis] + np.sign(centre[axis]) * top[axis] / 2
    mast_low, mast_high = np.array([*centre, height]), np.array([*centre, height + MAST_M[2]])
    mast_low[:2] -= MAST_M[0] / 2
    mast_high[:2] += MAST_M[0] / 2
    mast_low[axis], mast_high[axis] = sorted((far, far - np.sign(far) * MAST_M[1]))
    (low if far < 0 else high)[axis] = far
    mast = {"name": "mast", "min_m": _rounded(mast_low, 2), "max_m": _rounded(mast_high, 2)}
    return low, high, [mast]


def _outwards(values: Array, side: int) -> list[float]:
    """To whole centimetres, away from the middle."""
    return _rounded(side * np.ceil(side * values * 100 - 1e-6) / 100, 2)


def _rounded(values: Array, digits: int) -> list[float]:
    return [float(v) + 0.0 for v in np.round(values, digits)]


def to_toml(document: dict[str, Any]) -> str:
    """The document as TOML, with comments for a person."""
    names = {
        "preset": document["simulation"]["preset"],
        "seed": document["simulation"]["seed"],
        "path": f"config/{document['cell']['id']}.toml",
    }
    lines = _comment(COMMENTS[""].format(**names))
    _emit(document, "", lines)
    return "\n".join(lines) + "\n"


def _emit(table: dict[str, Any], path: str, lines: list[str]) -> None:
    """Values first, then tables, as TOML wants it."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict) and not _is_tables(v)}
    if path and (plain or path in COMMENTS):
        lines += ["", *_comment(COMMENTS.get(path, "")), f"[{path}]"]
    lines += [f"{key} = {_value(value)}" for key, value in plain.items()]
    for key, value in table.items():
        inner = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            _emit(value, inner, lines)
        elif _is_tables(value):
            for i, item in enumerate(value):
                comment = COMMENTS.get(inner, "") if i == 0 else ""
                lines += ["", *_comment(comment), f"[[{inner}]]"]
                lines += [f"{k} = {_value(v)}" for k, v in item.items()]


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in text.splitlines()]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(_value(v) for v in value)}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
