"""Solving without a cell: data sets on disk go through the same solvers as a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cellctl import projector_data
from cellctl.calib import hand_eye, intrinsic
from cellctl.calib.camera import CameraModel
from cellctl.calib.camera_fit import usable_views
from cellctl.calib.charuco import OTHER_PATTERN
from cellctl.calib.hand_eye_result import HandEyeResult
from cellctl.calib.intrinsic import IntrinsicLimits, IntrinsicResult
from cellctl.calib.observe import NOT_FOUND, Observed, observe, observe_with_robot
from cellctl.calib.views import Rejection, View
from cellctl.dataset import Dataset, load_dataset
from cellctl.errors import BadInput, SolveError
from cellctl.procedures.again import solve_run

MIRRORED_TRIED = 3
CAME_ALONG = IntrinsicLimits(views=3, coverage=0.0, rejected=1.0)
"""What pictures for the camera alone must reach: no more than is asked of a camera that comes
from the hand-eye views, which show whether it is good where it counts."""


def solve_folder(folder: Path) -> dict[str, Any]:
    """Solve a data set or, again, a recorded run; which of them `folder` is its files tell."""
    if (folder / "run.json").exists():
        return solve_run(folder)
    if projector_data.is_one(folder):
        return projector_data.solve(folder)
    return solve_dataset(folder)


@dataclass(frozen=True, eq=False)
class Answer:
    """What `cellctl solve --json` prints, and the result that it tells of, if there is one."""

    document: dict[str, Any]
    result: IntrinsicResult | HandEyeResult | None = None


def solve_dataset(folder: Path) -> dict[str, Any]:
    """Solve the data set in `folder`: what `cellctl solve --json` prints; see `answer`."""
    return answer(load_dataset(folder)).document


def answer(dataset: Dataset) -> Answer:
    """Solve a data set.

    BadInput names what cannot be used, a board that no picture shows included. When what is there
    does not determine an answer, the verdict is a fail with that reason. The order of the views
    does not matter.
    """
    solve = {"intrinsic": _solve_intrinsic, "hand-eye": _solve_hand_eye}[dataset.kind]
    solved = solve(dataset)
    return Answer({"kind": dataset.kind, **solved.document}, solved.result)


def _solve_intrinsic(dataset: Dataset) -> Answer:
    seen = observe(dataset.board, dataset.images())
    if _other_pattern(seen):
        return Answer(_unsolved(SolveError(OTHER_PATTERN), seen, dataset))
    require_board(seen, dataset, "views")
    try:
        result = _camera_from(seen, dataset, dataset.image_size)
    except SolveError as error:
        return Answer(_unsolved(error, seen, dataset))
    _, reasons = intrinsic.judge(result)
    return Answer(_judged(reasons, result.to_dict()), result)


def _solve_hand_eye(dataset: Dataset) -> Answer:
    assert dataset.mount is not None
    seen = observe_with_robot(dataset.board, dataset.images_with_robot())
    if _other_pattern(seen):
        return Answer(_unsolved(SolveError(OTHER_PATTERN), seen, dataset))
    require_board(seen, dataset, "views")
    doubts: tuple[str, ...] = ()
    camera: CameraModel | None = None
    extra: dict[str, Any] = {}
    try:
        if dataset.intrinsic_pictures:
            camera, doubts, extra = _camera_that_came_along(dataset)
        result = hand_eye.solve_hand_eye(
            seen.views,
            dataset.mount,
            camera=camera,
            image_size=dataset.image_size,
            minimum_points=dataset.board.minimum_points,
        )
    except SolveError as error:
        return Answer({**_unsolved(error, seen, dataset), **extra})
    result = replace(result, rejected=_merged(result.rejected, seen.unseen))
    _, reasons = hand_eye.judge(result)
    return Answer({**_judged((*doubts, *reasons), result.to_dict()), **extra}, result)


def _camera_from(
    seen: Observed[View], dataset: Dataset, image_size: tuple[int, int]
) -> IntrinsicResult:
    """Solved; the pictures that yielded no view are among the rejected."""
    result = intrinsic.solve_intrinsic(
        seen.views, image_size, minimum_points=dataset.board.minimum_points
    )
    return replace(result, rejected=_merged(result.rejected, seen.unseen))


def _camera_that_came_along(
    dataset: Dataset,
) -> tuple[CameraModel, tuple[str, ...], dict[str, Any]]:
    """The camera from the data set's own intrinsic pictures, for the hand-eye pictures' size;
    why it is not good enough; and what there is to say about it."""
    seen = observe(dataset.board, dataset.intrinsic_images())
    require_board(seen, dataset, "intrinsic_images")
    try:
        result = _camera_from(seen, dataset, dataset.intrinsic_image_size)
    except SolveError as error:
        raise SolveError(f"intrinsic_images: {error.message}") from None
    try:
        camera = result.camera.scaled(dataset.image_size)
    except BadInput as error:
        raise BadInput(f"{dataset.where}: intrinsic_image_size: {error.message}") from None
    _, doubts = intrinsic.judge(result, CAME_ALONG)
    _, remarks = intrinsic.judge(result)
    document = result.to_dict()
    facts = {key: document[key] for key in ("views", "rms_px", "held_out_px")}
    facts["remarks"] = [remark for remark in remarks if remark not in doubts]
    return camera, tuple(f"intrinsic_images: {doubt}" for doubt in doubts), {"intrinsic": facts}


def _other_pattern(seen: Observed[Any]) -> bool:
    """Whether no picture shows the board because its `legacy` is stated wrong: its pictures are
    sound, so that is a verdict on what was stated."""
    return not seen.sights and any(OTHER_PATTERN in unseen.reason for unseen in seen.unseen)


def require_board(seen: Observed[Any], dataset: Dataset, key: str) -> None:
    """BadInput when no picture shows the board."""
    if seen.sights:
        return
    board = ", ".join(f"{name} {value}" for name, value in dataset.board.to_dict().items())
    told = [r for r in seen.unseen if r.reason != NOT_FOUND][:1]
    clue = "".join(f"; view {r.id!r}: {r.reason}" for r in told)
    if _mirrored(dataset, key):
        clue = (
            "; seen in a mirror it is there: the pictures are mirrored, take them without flipping"
        )
    raise BadInput(
        f"{dataset.where}: {key}: the board ({board}) is not seen in any picture; check its "
        f"type, its counts and its dictionary{clue}"
    )


def _mirrored(dataset: Dataset, key: str) -> bool:
    """Whether one of the first pictures shows the board when it is flipped, as markers do."""
    pictures = dataset.images() if key == "views" else dataset.intrinsic_images()
    first = islice(pictures, MIRRORED_TRIED)
    return any(dataset.board.detect(np.ascontiguousarray(image[:, ::-1])) for _, image in first)


def _judged(reasons: Sequence[str], solved: dict[str, Any]) -> dict[str, Any]:
    return {"verdict": "fail" if reasons else "pass", "reasons": list(reasons), **solved}


def _unsolved(error: SolveError, seen: Observed[Any], dataset: Dataset) -> dict[str, Any]:
    """No answer, said as every answer is: pictures that are too few or too alike are no misuse."""
    _, few = usable_views(seen.views, dataset.board.minimum_points)
    told = [Rejection(name, reason) for name, reason in error.details.get("views", {}).items()]
    rejected = [rejection.to_dict() for rejection in _merged([*few, *told], seen.unseen)]
    return _judged([error.message], {"views": {"used": [], "rejected": rejected}})


def _merged(rejected: Sequence[Rejection], unseen: Sequence[Rejection]) -> tuple[Rejection, ...]:
    """By id: those that the solver rejected, and the pictures that never reached it. A verdict
    counts both."""
    return tuple(sorted([*rejected, *unseen], key=lambda rejection: rejection.id))
