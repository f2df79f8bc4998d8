"""Data sets: a folder of pictures and, for hand-eye, the poses that a robot reported.

The form is `cellctl-dataset/1`, a `dataset.json` that a person can write by hand. Lengths are
metres, transforms 4x4 row-major with p_parent = T_parent_child p_child, paths relative to the
folder. Unknown keys are ignored: people keep notes in such files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cellctl.calib.targets import Board, board_from_dict
from cellctl.errors import BadInput
from cellctl.geometry import Transform, as_transform

FORMAT = "cellctl-dataset/1"
FILE = "dataset.json"
KINDS = ("intrinsic", "hand-eye")
LATER_KINDS = ("markers",)
PROJECTOR_KIND = "projector-graycode"
"""Read by cellctl.projector_data."""

AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
"""Cameras write how they were held; a calibration is that of the sensor."""
FARTHEST_M = 100.0
"""No arm reaches that far: longer poses are in millimetres, or wrong."""

Mount = Literal["eye-to-hand", "eye-in-hand"]
Side = Annotated[int, Field(ge=16, le=32768, strict=True)]
Text = Annotated[str, Field(min_length=1, max_length=1000)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _View(_Model):
    id: Text
    image: Text
    T_base_flange: Any = None


class _File(_Model):
    """`dataset.json` as far as all kinds share it; boards and transforms are checked apart."""

    image_size: tuple[Side, Side]
    board: dict[str, Any]
    views: list[_View] = Field(min_length=1)
    mount: Mount | None = None
    intrinsic_images: list[_View | Text] = []
    intrinsic_image_size: tuple[Side, Side] | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture file of a data set; `T_base_flange` only for hand-eye."""

    id: str
    path: Path
    T_base_flange: Transform | None = None


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set that has been checked, except for its pictures. `where` names it in errors."""

    where: str
    kind: Literal["intrinsic", "hand-eye"]
    board: Board
    image_size: tuple[int, int]
    pictures: tuple[Picture, ...]
    mount: Mount | None
    intrinsic_pictures: tuple[Picture, ...]
    intrinsic_image_size: tuple[int, int]

    def images(self) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        """(id, grey picture), one at a time. BadInput names the file that cannot be used."""
        return self._read(self.pictures, self.image_size)

    def images_with_robot(self) -> Iterator[tuple[str, NDArray[np.uint8], Transform]]:
        """(id, grey picture, T_base_flange), one at a time."""
        for picture, (name, image) in zip(self.pictures, self.images(), strict=True):
            assert picture.T_base_flange is not None
            yield name, image, picture.T_base_flange

    def intrinsic_images(self) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        return self._read(self.intrinsic_pictures, self.intrinsic_image_size)

    def _read(
        self, pictures: tuple[Picture, ...], size: tuple[int, int]
    ) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        for picture in pictures:
            yield picture.id, read_picture(picture.path, size, f"{self.where}: view {picture.id!r}")


def load_dataset(folder: Path) -> Dataset:
    """Read and check `dataset.json` in `folder`, and that its pictures exist.

    BadInput names the file, the view and the key, and says what is wrong.
    """
    path = folder / FILE
    document = read_document(path)
    _check_kind(document, path)
    try:
        content = _File.model_validate(document)
    except ValidationError as error:
        raise BadInput(f"{path}: {explain(error, document)}") from None
    with_robot = document["kind"] == "hand-eye"
    if with_robot and content.mount is None:
        raise BadInput(f"{path}: a hand-eye data set needs mount: eye-to-hand or eye-in-hand")
    intrinsic = [
        view if isinstance(view, _View) else _View(id=view, image=view)
        for view in content.intrinsic_images
    ]
    return Dataset(
        where=str(path),
        kind=document["kind"],
        board=board_from_dict(content.board, f"{path}: board"),
        image_size=content.image_size,
        pictures=_pictures(content.views, path, with_robot=with_robot),
        mount=content.mount,
        intrinsic_pictures=_pictures(intrinsic, path, with_robot=False),
        intrinsic_image_size=content.intrinsic_image_size or content.image_size,
    )


def read_picture(path: Path, size: tuple[int, int], where: str) -> NDArray[np.uint8]:
    """A grey picture (h, w) of the given (w, h). BadInput says `where` it is wanted."""
    try:
        image = cv2.imread(str(path), AS_STORED)
    except cv2.error as error:
        raise BadInput(f"{where}: {path.name} cannot be read: {error.err}") from None
    if image is None:
        raise BadInput(f"{where}: {path.name} is not a picture that can be read")
    if image.shape != (size[1], size[0]):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise BadInput(f"{where}: {path.name} is {found}, not {size[0]}x{size[1]} as stated")
    return np.asarray(image, dtype=np.uint8)


def read_document(path: Path) -> dict[str, Any]:
    """A data set's JSON object, of this format. BadInput says what is wrong with it."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"{path.parent}: no {FILE} here; is it a data set?") from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not valid JSON: {error}") from None
    if not isinstance(document, dict):
        raise BadInput(f"{path}: must be a JSON object, not {type(document).__name__}")
    if document.get("format") != FORMAT:
        raise BadInput(f"{path}: the format must be {FORMAT!r}, not {document.get('format')!r}")
    return document


def _check_kind(document: dict[str, Any], path: Path) -> None:
    kind = document.get("kind")
    if kind in LATER_KINDS:
        raise BadInput(f"{path}: data sets of kind {kind!r} cannot be solved by this version")
    if kind not in KINDS:
        raise BadInput(f"{path}: unknown kind {kind!r}; known: {', '.join(KINDS)}")


def _pictures(views: list[_View], path: Path, *, with_robot: bool) -> tuple[Picture, ...]:
    seen: set[str] = set()
    pictures = []
    for view in views:
        where = f"{path}: view {view.id!r}"
        if view.id in seen:
            raise BadInput(f"{where}: this id is used more than once")
        seen.add(view.id)
        pictures.append(
            Picture(
                view.id, picture_path(path, view.image, where), _flange(view, where, with_robot)
            )
        )
    return tuple(sorted(pictures, key=lambda picture: picture.id))


def picture_path(path: Path, name: str, where: str) -> Path:
    """The file that a data set at `path` calls `name`. BadInput says `where` it is wanted."""
    relative = Path(name)
    if relative.is_absolute() or ".." in relative.parts:
        raise BadInput(
            f"{where}: image must be a path relative to the folder and within it, not {name!r}"
        )
    try:
        exists = (path.parent / relative).is_file()
    except (OSError, ValueError):
        exists = False
    if not exists:
        raise BadInput(f"{where}: image {name!r} does not exist")
    return path.parent / relative


def _flange(view: _View, where: str, with_robot: bool) -> Transform | None:
    if not with_robot:
        return None
    if view.T_base_flange is None:
        raise BadInput(f"{where}: missing key 'T_base_flange', the pose that the robot reported")
    pose = as_transform("base", "flange", view.T_base_flange, where)
    length = float(np.linalg.norm(pose.translation))
    if length > FARTHEST_M:
        raise BadInput(f"{where}: T_base_flange is {length:.4g} m long; are these millimetres?")
    return pose


def explain(error: ValidationError, document: dict[str, Any]) -> str:
    """What is wrong with a data set, key by key."""
    return "; ".join(_explain_one(item, document) for item in error.errors(include_url=False)[:5])


def _explain_one(item: Any, document: dict[str, Any]) -> str:
    """The key as a person finds it, with the id of the view that it belongs to."""
    key = ".".join(str(part) for part in item["loc"])
    words = "missing" if item["type"] == "missing" else str(item["msg"])
    if len(item["loc"]) > 2 and item["loc"][0] == "views":
        view = document["views"][item["loc"][1]]
        name = view.get("id") if isinstance(view, dict) else None
        return f"view {name!r} ({key}): {words}" if name is not None else f"{key}: {words}"
    return f"{key}: {words}"
