"""`cellctl board make`: boards to print."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from cellctl.cli.options import AsJson
from cellctl.cli.output import emit, say
from cellctl.errors import BadInput

app = typer.Typer(help="Calibration boards to print.", no_args_is_help=True)

OPTIONS = {
    "chessboard": {"--size": "inner_corners", "--square": "square_m"},
    "charuco": {
        "--size": "squares",
        "--square": "square_m",
        "--marker": "marker_m",
        "--dictionary": "dictionary",
        "--legacy": "legacy",
    },
    "aruco-grid": {
        "--size": "markers",
        "--marker": "marker_m",
        "--pitch": "pitch_m",
        "--dictionary": "dictionary",
        "--first-id": "first_id",
    },
    "dots": {"--size": "grid", "--spacing": "spacing_m"},
}
OPTIONAL = {"--legacy": False, "--first-id": 0}
Millimetres = Annotated[float | None, typer.Option(metavar="MM", min=0.1)]


@app.callback()
def board() -> None:
    """Calibration boards to print."""


@app.command()
def make(
    kind: Annotated[str, typer.Argument(metavar="TYPE", help=", ".join(OPTIONS))],
    size: Annotated[
        str,
        typer.Option(
            metavar="COLUMNSxROWS", help="Inner corners, squares (charuco), markers or dots."
        ),
    ],
    square: Millimetres = None,
    marker: Millimetres = None,
    pitch: Millimetres = None,
    spacing: Millimetres = None,
    dictionary: Annotated[str | None, typer.Option(help="As DICT_4X4_50.")] = None,
    first_id: Annotated[int | None, typer.Option(min=0)] = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="As before OpenCV 4.6.")] = False,
    page: Annotated[str | None, typer.Option(help="A4 to A0, or WxH in mm.")] = None,
    out: Annotated[Path, typer.Option(help="The PDF to write.")] = Path("board.pdf"),
    as_json: AsJson = False,
) -> None:
    """Write a board as PDF, at exact scale, with a ruler to check the printer."""
    given = {
        "--size": _size(size),
        "--square": _metres(square),
        "--marker": _metres(marker),
        "--pitch": _metres(pitch),
        "--spacing": _metres(spacing),
        "--dictionary": dictionary,
        "--first-id": first_id,
        "--legacy": legacy or None,
    }
    description = describe(kind, given)
    from cellctl.board_pdf import parse_page, write_board
    from cellctl.calib.targets import board_from_dict

    wanted = board_from_dict(description, "board")
    sheet = write_board(wanted, out, parse_page(page) if page else None)
    if as_json:
        emit({**vars(sheet), "board": description})
        return
    side = "landscape" if sheet.landscape else "portrait"
    say(f"{sheet.path}: {sheet.page}, {side}. Print at 100 % and measure the ruler.")
    say("For the cell's config, below [bracket.checkerboard] or [bracket.markers]:")
    say(sheet.config)


def describe(kind: str, given: dict[str, Any]) -> dict[str, Any]:
    """The board as a config has it; BadInput when an option is missing, or is of another type."""
    if kind not in OPTIONS:
        raise BadInput(f"no board type {kind!r}; there are: {', '.join(OPTIONS)}")
    options = OPTIONS[kind]
    chosen = {option: value for option, value in given.items() if value is not None}
    if strange := [option for option in chosen if option not in options]:
        raise BadInput(f"{kind} has no {strange[0]}; it has: {', '.join(options)}")
    chosen = {**{k: v for k, v in OPTIONAL.items() if k in options}, **chosen}
    if missing := [option for option in options if option not in chosen]:
        raise BadInput(f"{kind} also needs {', '.join(missing)}")
    return {"type": kind, **{options[option]: value for option, value in chosen.items()}}


def _size(text: str) -> list[int]:
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text)
    if not match:
        raise BadInput(f"--size {text!r}: expected COLUMNSxROWS, as 9x6")
    return [int(match[1]), int(match[2])]


def _metres(millimetres: float | None) -> float | None:
    return None if millimetres is None else round(millimetres / 1000, 9)
