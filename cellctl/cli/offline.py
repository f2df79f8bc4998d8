"""Commands that need no daemon. What they stand on is heavy, so it is imported when it is used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cellctl.cli.logs import log_to_stderr
from cellctl.cli.options import AsJson, ConfigFile
from cellctl.cli.output import emit, say
from cellctl.cli.results import print_data, print_verdict


def check_config(file: ConfigFile, as_json: AsJson = False) -> None:
    """Read a cell's TOML file and say what is wrong with it."""
    from cellctl.config import load_config

    config = load_config(file)
    facts = {
        "file": str(file),
        "cell": config.cell.id,
        "arm": config.robot.arm,
        "simulated": config.simulation is not None,
        "listen": config.bus.listen,
        "data_dir": str(config.data_dir()),
    }
    if as_json:
        emit({"valid": True, **facts})
        return
    say(f"{file}: valid")
    print_data({name: value for name, value in facts.items() if name != "file"})


def solve(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A data set or a run.")],
    score: Annotated[
        Path | None,
        typer.Option(metavar="OTHER", help="A data set of the same set-up to score it on."),
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Calibrate from a folder of images and poses, or solve a recorded run again.

    With --score the calibration predicts the views of OTHER, which it has not seen: score_px.
    """
    log_to_stderr()
    from cellctl.offline import solve_folder
    from cellctl.scoring import solve_and_score

    result = solve_folder(folder) if score is None else solve_and_score(folder, score)
    if as_json:
        emit(result)
    else:
        print_verdict(result["verdict"], result["reasons"])
        print_data({k: v for k, v in result.items() if k not in ("verdict", "reasons")})
    return 0 if result["verdict"] == "pass" else 1


def plan(
    procedure: Annotated[str, typer.Argument()],
    config: ConfigFile,
    out: Annotated[Path, typer.Option(help="The picture to write.")] = Path("plan.png"),
    as_json: AsJson = False,
) -> None:
    """Draw the poses, paths and keep-outs of a procedure. Nothing moves."""
    log_to_stderr()
    from cellctl.config import load_config
    from cellctl.plan_view import draw_plan

    facts = draw_plan(procedure, load_config(config), out)
    if as_json:
        emit(facts)
    else:
        print_data(facts)
