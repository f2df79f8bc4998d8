"""One good picture of a board: waited for, checked to be still, averaged.

Zero joint speed is not yet a sharp picture: an arm rings after it stops. So pictures are taken
until the board's corners stay where they were, and the mean of the next few is kept.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import cv2
import numpy as np

from cellctl.calib.printed import Unseen
from cellctl.calib.sharpness import TOO_BLURRED_PX, sharpness
from cellctl.calib.targets import Board, Detection
from cellctl.cell import Cell
from cellctl.drivers.base import Frame, Image, RobotState
from cellctl.errors import DeviceFault

DETECT_TIMEOUT_S = 20.0
BLOCK_PX, BLOCK_LEVELS = 16, 4


@dataclass(frozen=True)
class CaptureLimits:
    """When a picture is good. `rest_s`: cell time after standstill before the first counts, for
    an arm rings; `shift_px`: how far corners may then move between two pictures of a still board;
    `sharpness_px`: the widest edge; `seen_share`: of the board's points."""

    rest_s: float = 0.5
    shift_px: float = 0.05
    sharpness_px: float = TOO_BLURRED_PX
    seen_share: float = 0.75
    pictures: int = 4
    tries: int = 12


@dataclass(frozen=True, eq=False)
class Shot:
    """A mean picture, what was detected in it, and the arm's state during its exposure.

    `still`: the scene stood still. `flaw` says in words why the picture is not good; empty when
    it is.
    """

    image: Image
    detection: Detection | None
    state: RobotState
    pictures: int
    still: bool
    flaw: str


async def shoot(cell: Cell, board: Board, after: float, limits: CaptureLimits) -> Shot:
    """A picture of a still board; the arm has stood since cell time `after`."""
    frames, flaw = await _still_frames(cell, board, after + limits.rest_s, limits)
    image = await asyncio.to_thread(mean_image, frames)
    found = Unseen(flaw) if flaw else await look(cell, board, image)
    state = await cell.robot.state_at(frames[-1].t + frames[-1].exposure_s)
    flaw = flaw or _moving(frames, state)
    still = not flaw
    flaw = flaw or judge_sight(board, found, image, limits)
    detection = None if isinstance(found, Unseen) else found
    return Shot(image, detection, state, len(frames), still, flaw)


async def _still_frames(
    cell: Cell, board: Board, after: float, limits: CaptureLimits
) -> tuple[list[Frame], str]:
    """Frames of one still scene, or one frame and why there are no more."""
    last: Detection | None = None
    for _ in range(limits.tries):
        frame = await cell.camera.grab(exposed_after=after)
        after = frame.t + frame.exposure_s
        found = await look(cell, board, frame.image)
        if isinstance(found, Unseen):
            return [frame], found.reason
        if last is not None and shift_px(last, found) < limits.shift_px:
            return [frame, *await grab_frames(cell, after, limits.pictures - 1)], ""
        last = found
    return [frame], f"still moving after {limits.tries} pictures"


async def grab_frames(cell: Cell, after: float, count: int) -> list[Frame]:
    """`count` pictures in a row, the first exposed after cell time `after`."""
    frames: list[Frame] = []
    for _ in range(count):
        frames.append(await cell.camera.grab(exposed_after=after))
        after = frames[-1].t + frames[-1].exposure_s
    return frames


async def grab_still(cell: Cell, after: float, count: int, tries: int = 12) -> list[Frame]:
    """`count` pictures in a row of a scene that has stopped changing, exposed after cell time
    `after`. DeviceFault when it goes on changing."""
    last: Frame | None = None
    for _ in range(tries):
        frame = (await grab_frames(cell, after, 1))[0]
        after = frame.t + frame.exposure_s
        if last is not None and not await asyncio.to_thread(changed, last.image, frame.image):
            return [frame, *await grab_frames(cell, after, count - 1)]
        last = frame
    raise DeviceFault(
        f"the scene still changes after {tries} pictures: does something move in the light, or "
        "does another program use the projector?"
    )


def changed(a: Image, b: Image) -> bool:
    """Whether two pictures differ by more than noise: in the mean over any block of 16 x 16."""
    size = (max(a.shape[1] // BLOCK_PX, 1), max(a.shape[0] // BLOCK_PX, 1))
    blocks = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (a, b)]
    return bool(cv2.absdiff(*blocks).max() > BLOCK_LEVELS)


async def darken(cell: Cell) -> None:
    """Show black, so that nothing but the room lights the board."""
    width, height = cell.config.projector.size_px
    await cell.projector.show(np.zeros((height, width), np.uint8))


async def look(cell: Cell, board: Board, image: Image) -> Detection | Unseen:
    """`board.look(image)` in the solver's process."""
    found: Detection | Unseen = await cell.solver.call(
        board.look, image, timeout_s=DETECT_TIMEOUT_S
    )
    return found


def mean_image(frames: list[Frame]) -> Image:
    """The mean of pictures of one still scene, rounded to grey levels."""
    total = frames[0].image.astype(np.float32)
    for frame in frames[1:]:
        cv2.accumulate(frame.image, total)
    total /= len(frames)
    return np.rint(total, out=total).astype(np.uint8)


def shift_px(a: Detection, b: Detection) -> float:
    """How far the point of the board that moved furthest has moved, by the similarity that fits
    all points that both have; infinite with fewer than two. A turn shows as well as a shift."""
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(i) < 2:
        return float("inf")
    before, after = (points @ (1.0, 1.0j) for points in (a.pixels[i], b.pixels[j]))
    design = np.column_stack([before - before.mean(), np.ones(len(i))])
    change = np.linalg.lstsq(design, after - before, rcond=None)[0]
    return float(np.abs(design @ change).max())


def _moving(frames: list[Frame], state: RobotState) -> str:
    """Zero speed must have lasted since before the first of the frames; `state` is that at the end
    of the last one."""
    spanned = frames[-1].t + frames[-1].exposure_s - frames[0].t
    return "" if state.standstill_s > spanned else "the arm moved while the pictures were taken"


def judge_sight(
    board: Board, found: Detection | Unseen, image: Image, limits: CaptureLimits
) -> str:
    """What is wrong with what was seen; empty when nothing is."""
    if isinstance(found, Unseen):
        return found.reason
    share = len(found.ids) / len(board.points)
    if share < limits.seen_share:
        return f"partly seen: {share:.0%} of the board's points"
    blur = sharpness(image, found)
    if blur > limits.sharpness_px:
        return f"blurred: edges are {blur:.1f} px wide"
    return ""
