"""Data sets of a projector: captures of a board under Gray code, solved and scored.

The form is `cellctl-dataset/1` with kind `projector-graycode`: a view has `images`, the sequence
that `projector.pattern` describes (calib.graycode.code_from), and `projector.size` is [w, h].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import Sheet
from cellctl.calib.graycode import WHITE, GrayCode, code_from
from cellctl.calib.graycode_decode import Grey, decode
from cellctl.calib.graycode_local import at_places
from cellctl.calib.printed import Unseen
from cellctl.calib.procam import judge, solve_procam
from cellctl.calib.procam_fit import predicted
from cellctl.calib.procam_problem import Capture
from cellctl.calib.procam_screen import screened
from cellctl.calib.targets import Board, Detection, board_from_dict
from cellctl.calib.views import Rejection, rms
from cellctl.dataset import (
    FILE,
    Side,
    Text,
    explain,
    picture_path,
    read_document,
    read_picture,
)
from cellctl.dataset import PROJECTOR_KIND as KIND
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, as_transform

REACH, LEAST_REACH_PX, MOST_REACH_PX = 0.6, 8.0, 60.0
"""How far around a corner edges of the code are asked, in distances to its nearest neighbour."""


OUTSIDE = 0.05
"""Part of a capture's points that may be read outside the projector's picture."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Projector(_Model):
    size: tuple[Side, Side]
    pattern: Any = None


class _View(_Model):
    id: Text
    images: Annotated[list[Text], Field(min_length=1)]


class _File(_Model):
    image_size: tuple[Side, Side]
    board: dict[str, Any]
    projector: _Projector
    views: Annotated[list[_View], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class ProjectorSet:
    """A data set that has been checked, except for its pictures: `captures` are (id, files)."""

    where: str
    board: Board
    image_size: tuple[int, int]
    code: GrayCode
    captures: tuple[tuple[str, tuple[Path, ...]], ...]


@dataclass(frozen=True, eq=False)
class Read:
    """Captures that could be read, those that could not, and in how many pictures the board was
    seen; `corners`: how many, by id."""

    captures: list[Capture]
    unread: list[Rejection]
    corners: dict[str, int]


def is_one(folder: Path) -> bool:
    """Whether the data set in `folder` is of this kind; BadInput when it is none at all."""
    return bool(read_document(folder / FILE).get("kind") == KIND)


def load(folder: Path) -> ProjectorSet:
    """Read and check `dataset.json`, and that its pictures exist. BadInput names the file, the
    view and the key, and says what is wrong."""
    path = folder / FILE
    document = read_document(path)
    if document.get("kind") != KIND:
        raise BadInput(f"{path}: the kind must be {KIND!r}, not {document.get('kind')!r}")
    try:
        content = _File.model_validate(document)
    except ValidationError as error:
        raise BadInput(f"{path}: {explain(error, document)}") from None
    size = content.projector.size
    code = code_from(content.projector.pattern, size, f"{path}: projector.pattern")
    captures = [_capture(view, code, path) for view in content.views]
    names = [name for name, _ in captures]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise BadInput(f"{path}: view {twice[0]!r}: this id is used more than once")
    return ProjectorSet(
        where=str(path),
        board=board_from_dict(content.board, f"{path}: board"),
        image_size=content.image_size,
        code=code,
        captures=tuple(sorted(captures)),
    )


def _capture(view: _View, code: GrayCode, path: Path) -> tuple[str, tuple[Path, ...]]:
    where, wanted = f"{path}: view {view.id!r}", len(code.slides)
    if len(view.images) != wanted:
        bits = f"{len(code.bits('column'))} column bits, {len(code.bits('row'))} row bits"
        inverse = ", each with its inverse" if code.inverses else ""
        raise BadInput(
            f"{where}: images: {len(view.images)} pictures, but the pattern of a projector with "
            f"{code.size[0]}x{code.size[1]} pixels has {wanted} ({bits}{inverse}, white, black); "
            "see projector.size and projector.pattern"
        )
    if twice := [name for name in view.images if view.images.count(name) > 1]:
        raise BadInput(f"{where}: images: {twice[0]!r} is listed more than once")
    files = (picture_path(path, name, f"{where}: images") for name in view.images)
    return view.id, tuple(files)


def solve(folder: Path) -> dict[str, Any]:
    """Solve the data set in `folder`: what `cellctl solve --json` prints.

    BadInput names what cannot be used, a board that no capture shows included. When what is
    there does not determine an answer, the verdict is a fail with that reason.
    """
    dataset = load(folder)
    read = _read(dataset)
    if not read.corners:
        raise BadInput(
            f"{dataset.where}: the board {dataset.board.to_dict()} is not seen in the white "
            "picture of any view; check its type and counts, and projector.pattern"
        )
    try:
        result = solve_procam(
            read.captures, dataset.image_size, dataset.code.size, seen=read.corners
        )
    except SolveError as error:
        rejected = [r.to_dict() for r in read.unread] + error.details.get("rejected", [])
        rejected.sort(key=lambda rejection: rejection["id"])
        return _judged([error.message], {"views": {"used": [], "rejected": rejected}})
    rejected = sorted([*result.rejected, *read.unread], key=lambda rejection: rejection.id)
    result = replace(result, rejected=tuple(rejected))
    return _judged(judge(result)[1], {"board": dataset.board.to_dict(), **result.to_dict()})


def score(solved: dict[str, Any], folder: Path) -> float:
    """Projector pixels, root mean square, by which a calibration `solved` (what `solve` returns)
    misses the captures in `folder`: each board's pose is fitted to the camera's corners alone,
    and the projector's pixel at every corner is predicted; a board like the one of `solved` is
    taken to be as bent as that one was.

    BadInput when `solved` has no projector or the data set is none for its devices; SolveError
    when no capture can be read.
    """
    camera, projector, pose = _devices(solved)
    dataset = load(folder)
    for name, mine, theirs in (
        ("image_size", camera.image_size, dataset.image_size),
        ("projector.size", projector.image_size, dataset.code.size),
    ):
        if mine != theirs:
            raise BadInput(f"{dataset.where}: {name} is {theirs}, that of the calibration {mine}")
    read = _read(dataset)
    usable, rejected = screened(read.captures, read.corners)
    if not usable:
        why = "; ".join(f"{r.id}: {r.reason}" for r in [*read.unread, *rejected][:5])
        raise SolveError(f"{dataset.where}: no capture can be scored: {why}")
    ids = {capture.id for capture in usable}
    same = solved.get("board") == dataset.board.to_dict()
    warp = np.array(solved["board_warp_m"]) if same else np.zeros(3)
    sheet = Sheet.of(dataset.board.points)
    return rms(np.concatenate([
        predicted(camera, projector, pose, capture, warp, sheet)
        for capture in read.captures
        if capture.id in ids
    ]))  # fmt: skip


def _devices(solved: dict[str, Any]) -> tuple[CameraModel, CameraModel, Array]:
    missing = [key for key in ("camera", "projector", "T_projector_camera") if key not in solved]
    if missing:
        raise BadInput(f"the calibration has no {missing[0]}: its verdict may say why")
    projector = solved["projector"]
    if not isinstance(projector, dict):
        raise BadInput(f"projector: needs K, distortion and size, not {projector!r}")
    lens = {**projector, "image_size": projector.get("size")}
    pose = as_transform("projector", "camera", solved["T_projector_camera"])
    return (
        CameraModel.from_dict(solved["camera"]),
        CameraModel.from_dict(lens, "projector"),
        pose.matrix,
    )


def _judged(reasons: Sequence[str], solved: dict[str, Any]) -> dict[str, Any]:
    verdict = "fail" if reasons else "pass"
    return {"kind": KIND, "verdict": verdict, "reasons": list(reasons), **solved}


def _read(dataset: ProjectorSet) -> Read:
    """The projector's pixels at the corners that the camera sees, capture by capture."""
    read = Read([], [], {})
    for name, files in dataset.captures:
        pictures = _Pictures(dataset, name, files)
        found = dataset.board.look(pictures[dataset.code.index(WHITE)])
        if isinstance(found, Unseen):
            read.unread.append(Rejection(name, f"{found.reason}, all lit by the projector"))
            continue
        read.corners[name] = len(found.ids)
        try:
            capture = captured(name, found, pictures, dataset.code)
        except SolveError as error:
            read.unread.append(Rejection(name, error.message))
            continue
        if beyond := _beyond(capture, dataset.code.size):
            read.unread.append(Rejection(name, beyond))
        elif same := [c.id for c in read.captures if _same(c, capture)]:
            read.unread.append(Rejection(name, f"the same pictures as view {same[0]!r}"))
        else:
            read.captures.append(capture)
    return read


def captured(name: str, found: Detection, pictures: Sequence[Grey], code: GrayCode) -> Capture:
    """The board's points at which the code could be read. SolveError as graycode_decode."""
    reach = np.clip(REACH * _nearest(found.pixels), LEAST_REACH_PX, MOST_REACH_PX)
    low = np.floor(np.maximum((found.pixels - reach[:, None]).min(axis=0) - 4, 0)).astype(int)
    high = np.ceil((found.pixels + reach[:, None]).max(axis=0) + 5).astype(int)
    part = [image[low[1] : high[1], low[0] : high[0]] for image in pictures]
    local = at_places(decode(part, code), found.pixels - low, reach)
    good = local.found
    return Capture(
        name, found.points[good], found.pixels[good], local.pixels[good], local.slopes[good]
    )


def _nearest(pixels: Array) -> Array:
    """Distance (n,) of each of pixels (n, 2) to its nearest neighbour."""
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(np.minimum(apart.min(axis=1), MOST_REACH_PX / REACH))


def _beyond(capture: Capture, size: tuple[int, int]) -> str:
    """What is wrong when the code tells of pixels that the projector has not; else empty."""
    outside = int((capture.projector_px > np.array(size)).any(axis=1).sum())
    if outside <= OUTSIDE * len(capture.points):
        return ""
    x, y = capture.projector_px.max(axis=0)
    return (
        f"the code tells of projector pixels as far as ({x:.0f}, {y:.0f}), outside {size[0]}x"
        f"{size[1]}: check projector.size and projector.pattern"
    )


def _same(one: Capture, other: Capture) -> bool:
    return one.points.shape == other.points.shape and bool(
        np.array_equal(one.camera_px, other.camera_px)
        and np.array_equal(one.projector_px, other.projector_px)
    )


class _Pictures(Sequence[Grey]):
    """The pictures of a capture, read when they are asked for."""

    def __init__(self, dataset: ProjectorSet, name: str, files: tuple[Path, ...]) -> None:
        self._size, self._files = dataset.image_size, files
        self._where = f"{dataset.where}: view {name!r}"

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: Any) -> Any:
        return read_picture(self._files[index], self._size, self._where)

    def __iter__(self) -> Iterator[Grey]:
        return (self[i] for i in range(len(self)))
