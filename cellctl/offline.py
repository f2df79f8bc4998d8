"""Solving without a cell: data sets on disk go through the same solvers as a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cellctl.calib import hand_eye, intrinsic
from cellctl.calib.camera import CameraModel
from cellctl.calib.observe import observe, observe_with_robot
from cellctl.calib.views import Rejection
from cellctl.dataset import Dataset, load_dataset
from cellctl.errors import BadInput
from cellctl.procedures.again import solve_run


def solve_folder(folder: Path) -> dict[str, Any]:
    """Solve a data set or, again, a recorded run; which of them `folder` is its files tell."""
    if (folder / "run.json").exists():
        return solve_run(folder)
    return solve_dataset(folder)


def solve_dataset(folder: Path) -> dict[str, Any]:
    """Solve the data set in `folder`: what `cellctl solve --json` prints.

    BadInput names what cannot be used, a board that no picture shows included. SolveError when
    what is there does not determine an answer. The order of the views does not matter.
    """
    dataset = load_dataset(folder)
    solve = {"intrinsic": _solve_intrinsic, "hand-eye": _solve_hand_eye}[dataset.kind]
    return {"kind": dataset.kind, **solve(dataset)}


def _solve_intrinsic(dataset: Dataset) -> dict[str, Any]:
    seen = observe(dataset.board, dataset.images())
    _require_board(seen.views, dataset, "views")
    result = intrinsic.solve_intrinsic(
        seen.views, dataset.image_size, minimum_points=dataset.board.minimum_points
    )
    verdict, reasons = intrinsic.judge(result)
    return _document(result.to_dict(), verdict, reasons, seen.unseen)


def _solve_hand_eye(dataset: Dataset) -> dict[str, Any]:
    assert dataset.mount is not None
    camera, doubts = _camera(dataset) if dataset.intrinsic_pictures else (None, ())
    seen = observe_with_robot(dataset.board, dataset.images_with_robot())
    _require_board(seen.views, dataset, "views")
    result = hand_eye.solve_hand_eye(
        seen.views,
        dataset.mount,
        camera=camera,
        image_size=dataset.image_size,
        minimum_points=dataset.board.minimum_points,
    )
    verdict, reasons = hand_eye.judge(result)
    if doubts:
        verdict, reasons = "fail", (*doubts, *reasons)
    return _document(result.to_dict(), verdict, reasons, seen.unseen)


def _camera(dataset: Dataset) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera from the data set's own intrinsic pictures, for the hand-eye pictures' size;
    and why it may not be good enough."""
    seen = observe(dataset.board, dataset.intrinsic_images())
    _require_board(seen.views, dataset, "intrinsic_images")
    result = intrinsic.solve_intrinsic(
        seen.views, dataset.intrinsic_image_size, minimum_points=dataset.board.minimum_points
    )
    _, reasons = intrinsic.judge(result)
    try:
        camera = result.camera.scaled(dataset.image_size)
    except BadInput as error:
        raise BadInput(f"{dataset.where}: intrinsic_image_size: {error.message}") from None
    return camera, tuple(f"camera: {reason}" for reason in reasons)


def _require_board(views: Sequence[Any], dataset: Dataset, key: str) -> None:
    if not views:
        board = ", ".join(f"{name} {value}" for name, value in dataset.board.to_dict().items())
        raise BadInput(
            f"{dataset.where}: {key}: the board ({board}) is not seen in any picture; check its "
            "type, its counts and its dictionary"
        )


def _document(
    result: dict[str, Any], verdict: str, reasons: Sequence[str], unseen: Sequence[Rejection]
) -> dict[str, Any]:
    rejected = [*result["views"]["rejected"], *(rejection.to_dict() for rejection in unseen)]
    views = {**result["views"], "rejected": sorted(rejected, key=lambda item: item["id"])}
    return {"verdict": verdict, "reasons": list(reasons), **result, "views": views}
