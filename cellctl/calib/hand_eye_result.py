"""What a hand-eye solution says, and when it may be believed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import ChainState, Sheet
from cellctl.calib.drift import Drift
from cellctl.calib.hand_eye_choice import Candidate
from cellctl.calib.hand_eye_fit import Mount
from cellctl.calib.views import Rejection, shortage
from cellctl.geometry import Array, Transform

POSES = {
    "eye-to-hand": ("T_base_camera", "T_flange_board"),
    "eye-in-hand": ("T_flange_camera", "T_base_board"),
}
"""How results call the poses of camera and board, by mount."""


@dataclass(frozen=True, eq=False)
class HandEyeView:
    """One used view. `off_mm`, `off_deg`: between where its picture alone and where the chain
    has the board."""

    id: str
    rms_px: float
    held_out_px: float
    off_mm: float
    off_deg: float


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """`camera_pose` is T_base_camera or T_flange_camera, `board_pose` T_flange_board or
    T_base_board. `covariance` (12, 12) is that of small turns (rad) and shifts (m) of both, each
    in its own child frame. `candidates` are all ways that were tried; `why` says why `chosen`.
    `scale` and `warp` are those of the board, over its `sheet`: see chain.Sheet;
    `pitch_m` is the side of its squares or markers, or the spacing of its dots, as stated.
    `drift` is a trend in the order of the views; `turned` are the views in which the board was
    numbered from its other end.
    """

    mount: Mount
    camera: CameraModel
    camera_pose: Transform
    board_pose: Transform
    covariance: Array
    chosen: str
    why: str
    candidates: tuple[Candidate, ...]
    scale: float
    warp: Array
    sheet: Sheet
    pitch_m: float
    robot_sigma: Array
    axis_scatter_deg: Array
    rms_px: float
    held_out_px: float
    held_out_used_px: float
    views: tuple[HandEyeView, ...]
    rejected: tuple[Rejection, ...]
    drift: Drift | None = None
    turned: tuple[str, ...] = ()

    @property
    def state(self) -> ChainState:
        """The chain, without corrections of any view."""
        return ChainState(
            self.camera,
            self.camera_pose.matrix,
            self.board_pose.matrix,
            np.zeros((0, 4, 4)),
            float(np.log(self.scale)),
            self.warp,
        )

    @property
    def remarks(self) -> list[str]:
        """What was noticed, and is no reason to doubt the result by itself."""
        remarks = [str(self.drift)] if self.drift else []
        if self.turned:
            remarks.append(
                f"the board looks turned by half a turn in views {', '.join(self.turned)}: a print "
                "that is its own half turn may be numbered from either end; it was undone"
            )
        return remarks

    @property
    def summary(self) -> dict[str, float]:
        """In words of the workshop: how far pictures and robot disagree about the board."""
        mm = np.array([view.off_mm for view in self.views])
        deg = np.array([view.off_deg for view in self.views])
        sigma = np.sqrt(self.covariance.diagonal())
        return {
            "spread_rms_mm": float(np.sqrt(np.mean(mm**2))),
            "spread_max_mm": float(mm.max()),
            "spread_rms_deg": float(np.sqrt(np.mean(deg**2))),
            "camera_sigma_mm": float(1e3 * np.linalg.norm(sigma[3:6])),
            "camera_sigma_deg": float(np.degrees(np.linalg.norm(sigma[:3]))),
            "robot_sigma_mm": float(1e3 * self.robot_sigma[3]),
            "robot_sigma_deg": float(np.degrees(self.robot_sigma[0])),
            "board_scale": self.scale,
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON form, as `cellctl solve --json` prints it. The robot's frame is `base` and the
        board's `board` there, whatever they are called elsewhere."""
        camera, board = POSES[self.mount]
        return {
            "mount": self.mount,
            "views": {
                "used": [view.id for view in self.views],
                "rejected": [r.to_dict() for r in self.rejected],
            },
            "rms_px": self.rms_px,
            "held_out_px": self.held_out_px,
            "held_out_used_px": self.held_out_used_px,
            "camera": self.camera.to_dict(),
            camera: self.camera_pose.to_list(),
            board: self.board_pose.to_list(),
            "remarks": self.remarks,
            "method": self.chosen,
            "why": self.why,
            "candidates": {
                c.option.name: {"rms_px": c.rms_px, "held_out_px": c.held_out_px}
                for c in self.candidates
            },
            "summary": self.summary,
            "axis_scatter_deg": self.axis_scatter_deg.tolist(),
            "per_view": {
                v.id: {
                    "rms_px": v.rms_px,
                    "held_out_px": v.held_out_px,
                    "off_mm": v.off_mm,
                    "off_deg": v.off_deg,
                }
                for v in self.views
            },
        }


@dataclass(frozen=True)
class HandEyeLimits:
    """What hand-eye must reach to pass. The scatter of rotation axes: its smallest and its
    second value, degrees. `scale`: by how much a board may differ from its stated size."""

    views: int = 5
    held_out_px: float = 3.0
    scatter_deg: tuple[float, float] = (10.0, 20.0)
    rejected: float = 1.0 / 3.0
    spread_mm: float = 5.0
    scale: float = 0.01
    drift_mm: float = 1.0
    drift_deg: float = 0.1


def judge(
    result: HandEyeResult, limits: HandEyeLimits | None = None
) -> tuple[str, tuple[str, ...]]:
    """("pass" or "fail", reasons in words); a pass has no reasons."""
    limits = limits or HandEyeLimits()
    reasons = shortage(len(result.views), len(result.rejected), limits.views, limits.rejected)
    smallest, second, largest = result.axis_scatter_deg
    if smallest < limits.scatter_deg[0] or second < limits.scatter_deg[1]:
        reasons.append(
            f"the flange turned by {smallest:.0f}, {second:.0f} and {largest:.0f} degrees about "
            f"three axes; at least {limits.scatter_deg[0]:.0f} and {limits.scatter_deg[1]:.0f} "
            "are needed about the weaker two: add views tilted about other axes"
        )
    drift = result.drift
    if drift is not None and (drift.mm > limits.drift_mm or drift.deg > limits.drift_deg):
        reasons.append(f"{drift}; fix it, let it warm up, and take the views again")
    reasons += _errors(result, limits)
    return ("fail" if reasons else "pass"), tuple(reasons)


def _errors(result: HandEyeResult, limits: HandEyeLimits) -> list[str]:
    """What pictures, robot and board say against each other, beyond the limits."""
    reasons = []
    if not result.held_out_used_px <= limits.held_out_px:
        reasons.append(
            f"held-out error {result.held_out_used_px:.2f} px, over the limit of "
            f"{limits.held_out_px} px: look for a camera or a board that is loose, and compare the "
            "poses that the robot reports with where it is"
        )
    spread = result.summary["spread_rms_mm"]
    if not spread <= limits.spread_mm:
        reasons.append(
            f"pictures and robot disagree about the board by {spread:.1f} mm, over the limit of "
            f"{limits.spread_mm} mm: check that each pose is that of its picture, and that nothing "
            "is loose"
        )
    if not abs(result.scale - 1.0) <= limits.scale:
        way = "smaller" if result.scale < 1.0 else "larger"
        stated = 1e3 * result.pitch_m
        reasons.append(
            f"the board is {100 * abs(result.scale - 1.0):.1f} % {way} than stated, by the robot's "
            f"measure: what should be {stated:.2f} mm seems to be {stated * result.scale:.2f} mm; "
            "measure the board and state that"
        )
    return reasons
