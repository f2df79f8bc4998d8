"""A calibration from one data set, scored on another that it never saw."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cellctl import projector_data
from cellctl.calib.camera_fit import usable_views
from cellctl.calib.hand_eye_result import HandEyeResult
from cellctl.calib.intrinsic import IntrinsicResult
from cellctl.calib.observe import observe, observe_with_robot
from cellctl.calib.score import Score, score_camera, score_hand_eye
from cellctl.calib.views import Rejection
from cellctl.dataset import PROJECTOR_KIND, Dataset, load_dataset
from cellctl.errors import BadInput
from cellctl.offline import answer, require_board

SEEN = "the calibration has seen this picture"
APART = 3.0
"""A view is named when its error is that many times the median view's."""


def solve_and_score(folder: Path, other: Path) -> dict[str, Any]:
    """Solve the data set in `folder` and score the answer on the one in `other`.

    Returns what `cellctl solve --json` prints: the answer's document with `score_px`, over all
    points of all views, and `score` with `per_view_px`, the views `left_out` and `remarks`; of a
    projector in projector pixels.
    Intrinsic: each view's own pose of the board is fitted, nothing else. Hand-eye: each view is
    predicted through the robot. `score_px` is None when `folder` yields no answer. BadInput when
    the two are not of the same set-up.
    """
    for one in (folder, other):
        if (one / "run.json").exists():
            raise BadInput(f"{one}: a recorded run; scores need data sets (dataset.json)")
    projectors = [projector_data.is_one(one) for one in (folder, other)]
    if all(projectors):
        return _projector(folder, other)
    if any(projectors):
        raise BadInput(
            f"{other}: cannot score a calibration from {folder}: only one of them is of kind "
            f"{PROJECTOR_KIND!r}"
        )
    trained, unseen = load_dataset(folder), load_dataset(other)
    _require_alike(trained, unseen)
    unseen, seen_before = _without_seen(unseen, trained)
    solved = answer(trained)
    if solved.result is None:
        return {**solved.document, "score_px": None}
    score, left_out = _score(solved.result, trained, unseen)
    left_out = sorted([*left_out, *seen_before], key=lambda rejection: rejection.id)
    return {
        **solved.document,
        "score_px": score.px,
        "score": {
            "data_set": str(other),
            "per_view_px": score.per_view_px,
            "left_out": [rejection.to_dict() for rejection in left_out],
            "remarks": _remarks(score),
        },
    }


def _projector(folder: Path, other: Path) -> dict[str, Any]:
    """In projector pixels, the boards' poses being fitted to the camera's corners alone."""
    known = {_digest(path) for _, files in projector_data.load(folder).captures for path in files}
    for name, files in projector_data.load(other).captures:
        if any(_digest(path) in known for path in files):
            raise BadInput(
                f"{other}: pictures of capture {name!r} are in {folder} too: leave it out there or "
                "here; a score needs captures that the calibration has not seen"
            )
    solved = projector_data.solve(folder)
    if "projector" not in solved:
        return {**solved, "score_px": None}
    px = projector_data.score(solved, other)
    return {**solved, "score_px": px, "score": {"data_set": str(other)}}


def _require_alike(trained: Dataset, unseen: Dataset) -> None:
    """BadInput names what a calibration does not carry over to."""
    where = f"{unseen.where}: cannot score a calibration from {trained.where}"
    pairs: list[tuple[str, Any, Any]] = [
        ("kind", trained.kind, unseen.kind),
        ("image_size", _size(trained), _size(unseen)),
        ("mount", trained.mount, unseen.mount),
    ]
    if trained.kind == "hand-eye":
        pairs.append(("board", trained.board.to_dict(), unseen.board.to_dict()))
    for key, ours, theirs in pairs:
        if ours != theirs:
            raise BadInput(f"{where}: its {key} is {theirs}, not {ours}")


def _size(dataset: Dataset) -> str:
    return "x".join(str(side) for side in dataset.image_size)


def _without_seen(unseen: Dataset, trained: Dataset) -> tuple[Dataset, list[Rejection]]:
    """Without pictures that the calibration rests on; BadInput when there are no others."""
    known = {_digest(p.path) for p in (*trained.pictures, *trained.intrinsic_pictures)}
    seen = {picture.id for picture in unseen.pictures if _digest(picture.path) in known}
    new = tuple(picture for picture in unseen.pictures if picture.id not in seen)
    if not new:
        raise BadInput(
            f"{unseen.where}: all its pictures are in {trained.where} too; a score needs pictures "
            "that the calibration has not seen"
        )
    return replace(unseen, pictures=new), [Rejection(name, SEEN) for name in seen]


def _digest(path: Path) -> bytes:
    try:
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error}") from None


def _score(
    result: IntrinsicResult | HandEyeResult, trained: Dataset, unseen: Dataset
) -> tuple[Score, list[Rejection]]:
    """Errors of the views that can be scored, and the others."""
    if isinstance(result, IntrinsicResult):
        seen = observe(unseen.board, unseen.images())
        require_board(seen, unseen, "views")
        views, few = usable_views(seen.views, unseen.board.minimum_points)
        _require_some(views, [*few, *seen.unseen], unseen)
        same = trained.board == unseen.board
        return score_camera(result, views, same_board=same), [*few, *seen.unseen]
    moved = observe_with_robot(unseen.board, unseen.images_with_robot())
    require_board(moved, unseen, "views")
    _require_some(moved.views, moved.unseen, unseen)
    try:
        return score_hand_eye(result, moved.views), moved.unseen
    except BadInput as error:
        raise BadInput(f"{unseen.where}: {error.message}") from None


def _require_some(views: Sequence[Any], left_out: Sequence[Rejection], dataset: Dataset) -> None:
    if not views:
        why = "".join(f"; {r.id}: {r.reason}" for r in left_out[:5])
        raise BadInput(f"{dataset.where}: no view that could be scored{why}")


def _remarks(score: Score) -> list[str]:
    """Views that stand apart: they count, but their picture or pose may be at fault."""
    errors = score.per_view_px
    median = float(np.median(list(errors.values())))
    return [
        f"view {name!r} has {error:.2f} px, the median view {median:.2f} px"
        for name, error in errors.items()
        if error > APART * median
    ]
