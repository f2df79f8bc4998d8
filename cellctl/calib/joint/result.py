"""What the joint adjustment found, as a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.joint.noise import Information
from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.pictures import world_camera
from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.state import FullProjector, JointState, Layout
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.schur import Solution
from cellctl.geometry import Array, Transform


@dataclass(frozen=True, eq=False)
class JointResult:
    """`information` by group of observations, see `noise.information`."""

    seen: Observations
    start: Calibration
    solution: Solution[JointState]
    information: Mapping[str, Information]

    @property
    def problem(self) -> JointProblem:
        assert isinstance(self.solution.problem, JointProblem)
        return self.solution.problem

    @property
    def state(self) -> JointState:
        return self.solution.state

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    @property
    def sigma(self) -> Mapping[str, float]:
        """Noise of each group of observations, units as in JointProblem."""
        return {n: s for n, s in self.problem.sigma.items() if n in self.information}

    @cached_property
    def covariance(self) -> Array:
        """(g, g) of the globals, in the order of `layout`; poses by small turns (rad) and shifts
        (m) in their child frame."""
        return self.solution.globals_covariance

    def covariance_of(self, name: str) -> Array:
        """That of one group of unknowns, of Layout's names. KeyError for what was not free."""
        place = self.layout.slices[name]
        return self.covariance[place, place]

    @cached_property
    def calibration(self) -> Calibration:
        """With the smooth displacements of the circles, and what the table's bow does to the
        picture, as a refinement of the family "joint"."""
        state = self.state
        T = world_camera(state, self.problem.look)
        return Calibration(
            camera=state.camera,
            T_world_camera=Transform("world", "camera", T),
            table=state.table.plane,
            projector=projector_map(state, T),
            boards={
                name: Transform("flange", name, board.pose)
                for name, board in state.boards.items()
                if f"{name} pose" in self.layout and self.seen.mount == "eye-to-hand"
            },
            refinement=None
            if self.problem.field is None
            else self.problem.field.refinement(state.field),
        )


def projector_map(state: JointState, T_world_camera: Array) -> ProjectorMap:
    """The map from the camera's plane by way of the table's plane. That of a full projector has
    its lens exactly; a table's bow is left out."""
    if isinstance(state.projector, ProjectorMap):
        return state.projector
    full: FullProjector = state.projector
    plane, lens = state.table.plane, full.lens
    # X = C + r (n.(q - C) / n.r): linear in the ray r up to scale.
    C, R = T_world_camera[:3, 3], T_world_camera[:3, :3]
    to_world = (np.outer(C, plane.normal) + ((plane.point - C) @ plane.normal) * np.eye(3)) @ R
    offset = plane.normal @ R  # the homogeneous coordinate n.r
    inverse = np.linalg.inv(full.pose)
    H = lens.K @ (inverse[:3, :3] @ to_world + np.outer(inverse[:3, 3], offset))
    return ProjectorMap(H / H[2, 2], lens.K[:2, 2], lens.K[0, 0], lens.distortion[:2])
