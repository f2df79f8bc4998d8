"""The guard: every path of every procedure passes it, whole, before anything moves.

It checks the arm's links, boards and pen, as spheres (`cellctl.hulls`), along the straight joint
lines from the measured joints, against the workspace box, keep-outs, the table, camera and
projector, the arm itself and the joint limits. It is not a safety function: it knows what the
config says, and a person's arm is not in the config.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from cellctl.arms import JOINTS, ArmModel, arm
from cellctl.config import Box, CellConfig, TableSection
from cellctl.drivers.base import Path, Stroke
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, Mask
from cellctl.hulls import Body, box_body, link_bodies, pen_body
from cellctl.scene import ENDLESS, TABLE, Keepout, Pen, Scene

FIRST_FREE_FRAME = 2
"""Links before this one stand where the arm is bolted down: table and workspace box do not bind
them. This one, the upper arm, starts there: it keeps its hull clear, but no clearance more."""
LAST_ARM_FRAME = 4
"""Shoulder, arm and first wrist link are checked against each other from two frames apart; the
base, and what the wrist carries, from three apart: nearer ones are joined and always near."""
MAX_STEP_M = 0.01
"""No sphere moves further than this between two checked states of a path."""
COARSE = 8
PIECES = 8
"""A joint line is cut into so many to find the speed of its fastest sphere."""
PEN = "pen"
SLACK_M, SLACK_RAD = 0.005, 0.005
"""Half of MAX_STEP_M: another start shifts the states at which a path is sampled."""


@dataclass(frozen=True)
class Violation:
    """Which of the checked states is refused first, and why in words."""

    index: int
    reason: str


@dataclass(frozen=True, eq=False)
class Rule:
    """What each of `who` must not do, and in which of the checked states it does: (n, len(who))."""

    what: str
    who: tuple[str, ...]
    broken: Mask


class Guard:
    """Decides about joint vectors and paths; pure, moves nothing."""

    def __init__(
        self,
        model: ArmModel,
        bodies: tuple[Body, ...],
        scene: Scene,
        clearance_m: float,
        joint_margin_rad: float,
        pen: Pen | None = None,
    ) -> None:
        self.arm, self.bodies, self.scene, self.pen = model, bodies, scene, pen
        self.clearance, self.joint_margin = clearance_m, joint_margin_rad
        free = [body for body in bodies if body.frame >= FIRST_FREE_FRAME]
        self._free_bodies = free
        self._who = tuple(body.name for body in free for _ in body.radii)
        self._reach = np.concatenate(
            [body.radii + clearance_m * (body.frame > FIRST_FREE_FRAME) for body in free]
        )
        self._wraps = [body.wrapped() for body in bodies]
        self._free = [i for i, body in enumerate(bodies) if body.frame >= FIRST_FREE_FRAME]
        ends = np.cumsum([len(body.radii) for body in free])
        self._parts = [slice(end - len(b.radii), end) for end, b in zip(ends, free, strict=True)]
        kept = [clearance_m * (body.frame > FIRST_FREE_FRAME) for body in free]
        self._wrap_reach = np.concatenate([self._wraps[i].radii for i in self._free]) + kept
        self._pairs = _pairs(bodies)
        self._pair_names = tuple(f"{bodies[i].name} and {bodies[j].name}" for i, j in self._pairs)

    def cautious(self, *postures: Array) -> Guard:
        """A guard that keeps SLACK_M and SLACK_RAD more away from everything, to plan with: its
        paths are still allowed when the arm stands a little off where it stood at planning. This
        guard itself where the cautious one would not let the arm be at one of `postures` (6,)."""
        bodies = tuple(replace(body, radii=body.radii + SLACK_M) for body in self.bodies)
        margin = self.joint_margin + SLACK_RAD
        cautious = Guard(self.arm, bodies, self.scene, self.clearance, margin, self.pen)
        return cautious if cautious.free(np.array(postures)).all() else self

    def free(self, joints: Array) -> Mask:
        """Whether each of joints (n, 6) is allowed."""
        return ~np.logical_or.reduce([rule.broken.any(axis=1) for rule in self.rules(joints)])

    def first_violation(self, joints: Array) -> Violation | None:
        """The first of joints (n, 6) that is refused."""
        first: Violation | None = None
        for rule in self.rules(joints):
            index = int(np.argmax(rule.broken.any(axis=1)))
            broken = rule.broken[index]
            if broken.any() and (first is None or index < first.index):
                first = Violation(index, f"{rule.who[int(np.argmax(broken))]} {rule.what}")
        return first

    def draws(self, joints: Array) -> Mask:
        """Whether each of joints (n, 6) is allowed to an arm that draws: as `free`, but the pen may
        be on the table."""
        rules = self._drawing_rules(np.atleast_2d(joints))
        return ~np.logical_or.reduce([rule.broken.any(axis=1) for rule in rules])

    def check_stroke(self, stroke: Stroke) -> None:
        """MotionRefused unless all of a stroke is allowed. In it, and only in it, the pen may come
        down to the table over a sheet, and be pushed in by its travel."""
        joints = np.asarray(stroke.joints, dtype=float)
        if joints.ndim != 2 or joints.shape[1] != JOINTS or not len(joints):
            raise MotionRefused(f"a stroke is (n, {JOINTS}) joint angles, not {joints.shape}")
        if not np.isfinite(joints).all() or not 0.0 < stroke.speed_m_s < np.inf:
            raise MotionRefused("a stroke is finite joint angles and a speed above zero")
        steps = np.linalg.norm(np.diff(self.spheres(joints)[0], axis=0), axis=2)
        if steps.max(initial=0.0) > MAX_STEP_M:
            raise MotionRefused(
                f"a stroke's points are {1e3 * steps.max():.0f} mm apart, more than "
                f"{1e3 * MAX_STEP_M:.0f} mm: what lies between them cannot be checked"
            )
        for rule in self._drawing_rules(joints):
            index = int(np.argmax(rule.broken.any(axis=1)))
            if rule.broken[index].any():
                share = index / max(len(joints) - 1, 1)
                who = rule.who[int(np.argmax(rule.broken[index]))]
                raise MotionRefused(f"stroke refused at {share:.0%} of its way: {who} {rule.what}")

    def _drawing_rules(self, joints: Array) -> list[Rule]:
        pen = self.pen
        if pen is None:
            raise MotionRefused("this guard knows no pen: nothing may touch the table")
        rules = [_without_pen(rule) if rule.what == TABLE else rule for rule in self.rules(joints)]
        tips = pen.tips(self.arm.forward(joints))
        height = tips[:, 2] - self.scene.table_height
        deep, low = height < -pen.travel, height < self.clearance
        off = low & ~pen.on_sheet(tips[:, :2])
        return [
            *rules,
            Rule("is pushed in further than its holder gives way", ("the pen",), deep[:, None]),
            Rule("comes down beside the sheets", ("the pen",), off[:, None]),
        ]

    def rules(self, joints: Array) -> list[Rule]:
        """All rules, looked at in joints (n, 6)."""
        joints = np.atleast_2d(joints)
        frames = self.arm.link_frames(joints)
        outside = ~self.arm.within_limits(joints, self.joint_margin)
        limit = Rule("is at its limit", ("a joint",), outside[:, None])
        spheres = [body.world(frames) for body in self.bodies]
        wraps = [wrap.world(frames) for wrap in self._wraps]
        return [limit, *self._surroundings(spheres, wraps), self._self_collision(spheres, wraps)]

    def check(self, start: Array, path: Path) -> None:
        """MotionRefused unless the whole path from the joints `start` (6,) is allowed."""
        waypoints = np.asarray(path.waypoints, dtype=float)
        if waypoints.ndim != 2 or waypoints.shape[1] != JOINTS or not np.isfinite(waypoints).all():
            raise MotionRefused(
                f"a path is (n, {JOINTS}) finite joint angles, not {waypoints.shape}"
            )
        joints = self.sample(start, path)
        violation = self.first_violation(joints)
        if violation is None:
            return
        if violation.index == 0:
            raise MotionRefused(
                f"the arm stands where it must not: {violation.reason}; jog it clear by hand"
            )
        share = violation.index / (len(joints) - 1)
        degrees = ", ".join(f"{v:.1f}" for v in np.degrees(joints[violation.index]))
        raise MotionRefused(
            f"path refused at {share:.0%} of its way: {violation.reason} (joints {degrees} deg)"
        )

    def allows(self, start: Array, path: Path) -> bool:
        """Whether `check` would pass. Looks at a few states first: most refusals show there."""
        joints = self.sample(start, path)
        return bool(self.free(joints[::COARSE]).all() and self.free(joints).all())

    def sample(self, start: Array, path: Path) -> Array:
        """Joints (n, 6) along a path, so close that no sphere moves more than MAX_STEP_M."""
        corners = np.vstack([start, path.waypoints])
        pieces = [corners[:1]]
        for a, b in itertools.pairwise(corners):
            count = max(int(np.ceil(self._travel(a, b) / MAX_STEP_M)), 1)
            pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
        return np.vstack(pieces)

    def tip_speed(self, start: Array, path: Path, joint_speed: float) -> float:
        """The fastest that any sphere moves, m/s, when the leading joint runs at `joint_speed`."""
        corners = np.vstack([start, path.waypoints])
        fastest = 0.0
        for a, b in itertools.pairwise(corners):
            duration = np.abs(b - a).max() / joint_speed
            if duration > 0:
                fastest = max(fastest, self._travel(a, b) / duration)
        return fastest

    def spheres(self, joints: Array, bodies: list[Body] | None = None) -> tuple[Array, Array]:
        """Centres (n, m, 3) and radii (m,) of `bodies` (all that may move freely) for (n, 6)."""
        chosen = self._free_bodies if bodies is None else bodies
        frames = self.arm.link_frames(np.atleast_2d(joints))
        centres = np.concatenate([body.world(frames) for body in chosen], axis=1)
        return centres, np.concatenate([body.radii for body in chosen])

    def _travel(self, a: Array, b: Array) -> float:
        """How far any sphere would travel on the joint line a-b at the fastest that any of them
        moves anywhere on it (to within a few percent)."""
        joints = a + (b - a) * np.linspace(0.0, 1.0, PIECES + 1)[:, None]
        centres, _ = self.spheres(joints)
        return float(PIECES * np.linalg.norm(np.diff(centres, axis=0), axis=2).max())

    def _surroundings(self, spheres: list[Array], wraps: list[Array]) -> list[Rule]:
        """Looked at sphere by sphere where the ball around a body comes near to anything."""
        names = self.scene.names()
        broken = np.zeros((len(names), len(wraps[0]), len(self._who)), dtype=bool)
        balls = np.concatenate([wraps[i] for i in self._free], axis=1)
        near = np.logical_or.reduce(self.scene.broken(balls, self._wrap_reach))
        for k, (i, part) in enumerate(zip(self._free, self._parts, strict=True)):
            some = near[:, k]
            if some.any():
                broken[:, some, part] = self.scene.broken(spheres[i][some], self._reach[part])
        return [Rule(name, self._who, mask) for name, mask in zip(names, broken, strict=True)]

    def _self_collision(self, spheres: list[Array], wraps: list[Array]) -> Rule:
        """Which pairs of bodies meet: looked at sphere by sphere where the balls around them do."""
        balls = np.concatenate(wraps, axis=1)
        radii = np.concatenate([wrap.radii for wrap in self._wraps])
        i, j = np.array(self._pairs).T
        near = ((balls[:, i] - balls[:, j]) ** 2).sum(axis=-1) < (radii[i] + radii[j]) ** 2
        for k in np.flatnonzero(near.any(axis=0)):
            a, b, some = i[k], j[k], near[:, k]
            one, other = spheres[a][some], spheres[b][some]
            around = ((other - balls[some, a, None]) ** 2).sum(axis=-1)
            close = (around < (radii[a] + self.bodies[b].radii) ** 2).any(axis=0)
            other, other_radii = other[:, close], self.bodies[b].radii[close]
            near[some, k] = close.any() and _meet(one, self.bodies[a].radii, other, other_radii)
        return Rule("meet", self._pair_names, near)


def _without_pen(rule: Rule) -> Rule:
    others = np.array([who != PEN for who in rule.who])
    return Rule(rule.what, rule.who, rule.broken & others)


def _pairs(bodies: tuple[Body, ...]) -> list[tuple[int, int]]:
    return [
        (i, j)
        for i, one in enumerate(bodies)
        for j, other in enumerate(bodies)
        if i < j and _can_meet(one.frame, other.frame)
    ]


def _can_meet(one: int, other: int) -> bool:
    inner = min(one, other) >= 1 and max(one, other) <= LAST_ARM_FRAME
    return abs(one - other) >= (2 if inner else 3)


def _meet(a: Array, a_radii: Array, b: Array, b_radii: Array) -> Mask:
    """Whether any sphere of (n, k, 3) touches any of (n, m, 3)."""
    squares = (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None] - 2 * a @ np.swapaxes(b, 1, 2)
    return (squares - (a_radii[:, None] + b_radii) ** 2).min(axis=(1, 2)) < 0.0


def guard_of(config: CellConfig) -> Guard:
    """The guard of a configured cell. Camera and projector are balls around their tape-measured
    places, larger by what the tape may be off."""
    model = arm(config.robot.arm)
    bracket, space = config.bracket, config.workspace
    bodies = (
        *link_bodies(model),
        _hull("checkerboard", bracket.checkerboard.hull),
        _hull("marker board", bracket.markers.hull),
        pen_body(bracket.pen.tip_m, bracket.pen.radius_m),
    )
    radius = space.device_radius_m + config.tape.position_m
    scene = Scene(
        box_low=np.array(space.box.min_m),
        box_high=np.array(space.box.max_m),
        table_height=config.table.touched_height_m,
        table_top=_top(config.table),
        keepouts=tuple(
            Keepout(box.name, np.array(box.min_m), np.array(box.max_m)) for box in space.keep_outs
        ),
        balls=(
            ("camera", np.array(config.camera.pose.position_m), radius),
            ("projector", np.array(config.projector.pose.position_m), radius),
        ),
    )
    sheets = np.array([(s.min_m, s.max_m) for s in config.sheets]).reshape(-1, 2, 2)
    pen = Pen(np.array(bracket.pen.tip_m), bracket.pen.travel_m, sheets)
    margin = float(np.radians(space.joint_margin_deg))
    return Guard(model, bodies, scene, space.clearance_m, margin, pen)


def _top(table: TableSection) -> Array:
    return ENDLESS if table.top is None else np.array([table.top.min_m, table.top.max_m])


def _hull(name: str, hull: Box) -> Body:
    low, high = np.array(hull.min_m), np.array(hull.max_m)
    return box_body(name, JOINTS, (low + high) / 2, high - low)
