"""What pydantic found wrong, in words for whoever wrote it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

MOST = 20


def explain(
    error: ValidationError, model: type[BaseModel], *, what: str = "key", most: int = MOST
) -> str:
    """At most `most` of the errors of `model`, each with its place. An unknown name comes with
    the nearest one known there; `what` says what the names are of."""
    items = error.errors(include_url=False, include_input=False, include_context=False)
    return "; ".join(_explain(item, model, what) for item in items[:most])


def nearest(name: str, known: Iterable[str]) -> str:
    """`; did you mean ...?` or, when none is near, what there is."""
    names = sorted(known)
    if close := difflib.get_close_matches(name, names, n=1, cutoff=0.5):
        return f"; did you mean {close[0]!r}?"
    return f"; known here: {', '.join(names) or 'none'}"


def _explain(item: Any, model: type[BaseModel], what: str) -> str:
    place = item["loc"]
    name = ".".join(str(part) for part in place)
    if item["type"] == "extra_forbidden":
        return f"unknown {what} {name!r}{nearest(str(place[-1]), _names_at(model, place[:-1]))}"
    if item["type"] == "missing":
        return f"missing {what} {name!r}"
    message = str(item["msg"]).removeprefix("Value error, ")
    return f"{name}: {message}" if name else message


def _names_at(model: type[BaseModel], place: tuple[Any, ...]) -> Iterable[str]:
    """The fields of the model at `place` within `model`; numbers count the items of a list."""
    found: type[BaseModel] | None = model
    for part in place:
        if found is not None and part in found.model_fields:
            found = _model_in(found.model_fields[part].annotation)
    return found.model_fields if found is not None else ()


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as `Section | None` or `tuple[Section, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_in, get_args(annotation))), None)
