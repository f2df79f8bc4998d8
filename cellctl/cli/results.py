"""Results as a person reads them: the verdict first, then tables and figures."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from cellctl.cli import words
from cellctl.cli.output import out, say
from cellctl.messages import RunInfo

MAX_ROWS = 40
NAME_WIDTH = 26
DRAWN_IN_REPORT = ("table", "arrows")
"""Of a result: its table is printed as one, its arrows are for the report."""


def print_run(run: RunInfo) -> None:
    """A run: outcome, reasons, figures, where it lies, what to do next."""
    say(words.headline(run))
    for reason in run.reasons:
        say(f"  - {reason}")
    if run.question:
        say(f"It asks: {run.question.text}")
    data = (run.result or {}).get("data")
    if isinstance(data, dict):
        print_data({name: value for name, value in data.items() if name not in DRAWN_IN_REPORT})
        if isinstance(rows := data.get("table"), list):
            print_table_two(rows)
    facts = {
        "calibration": run.calibration_id,
        "recorded": f"{run.samples} samples in {run.directory}" if run.directory else None,
        "report": words.report(run),
    }
    print_data({name: value for name, value in facts.items() if value})
    for text in words.advice(run):
        say(text)


def print_verdict(verdict: Any, reasons: Any) -> None:
    """As `PASS` or `FAIL`, with the reasons."""
    say(str(verdict).upper())
    for reason in reasons or []:
        say(f"  - {reason}")


def print_data(data: dict[str, Any]) -> None:
    """Any JSON object: figures by name, rows of equal objects as a table. What is long or deep
    is only counted; `--json` shows it."""
    tables = {name: rows for name, rows in data.items() if _is_table(rows)}
    figures = _figures({k: v for k, v in data.items() if k not in tables})
    width = max((len(name) for name, _ in figures), default=0)
    for name, value in figures:
        out.print(f"{name:<{max(width, NAME_WIDTH)}} {value}", markup=False, soft_wrap=True)
    for name, rows in tables.items():
        print_table(name, rows)


def print_table(title: str, rows: list[dict[str, Any]]) -> None:
    """Rows with the same keys; more than 40 are cut, and columns of objects left out."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    columns = [
        column
        for column in dict.fromkeys(key for row in rows for key in row)
        if not any(isinstance(row.get(column), dict) for row in rows)
    ]
    for column in columns:
        figures = all(isinstance(row.get(column), int | float | None) for row in rows)
        width = max(len(column), *(len(short(row.get(column))) for row in rows))
        table.add_column(
            column,
            overflow="fold",
            justify="right" if figures else "left",
            min_width=width if figures else None,
        )
    for row in rows[:MAX_ROWS]:
        table.add_row(*(short(row.get(column)) for column in columns))
    out.print(table)
    if len(rows) > MAX_ROWS:
        say(f"... and {len(rows) - MAX_ROWS} more (--json shows all)")


def print_table_two(rows: list[dict[str, Any]]) -> None:
    """The paper's Table II, ours and the paper's: root mean squares, px / mm."""
    pairs = [
        {
            "px / mm": row["row"],
            **{name: _pair(row, key) for name, key in TABLE_TWO.items()},
        }
        for row in rows
    ]
    print_table("Table II: light against ink", pairs)


TABLE_TWO = {"training": "training", "held out": "held_out", "true": "true", "the paper": "paper"}


def _pair(row: dict[str, Any], key: str) -> str:
    px, mm = row.get(f"{key}_px"), row.get(f"{key}_mm")
    return "-" if px is None or mm is None else f"{px:.2f} / {mm:.2f}"


def short(value: Any) -> str:
    """A value in a cell of a table."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return _short_list(value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {short(item)}" for key, item in value.items())
    return str(value)


def _short_list(value: list[Any]) -> str:
    if len(value) > 6 or any(isinstance(item, list | dict) for item in value):
        return f"({len(value)} items)"
    return " ".join(short(item) for item in value) or "none"


def _figures(data: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    lines: list[tuple[str, str]] = []
    for name, value in data.items():
        if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()) and prefix:
            lines.append((prefix + name, f"({len(value)} items)"))
        elif isinstance(value, dict) and value:
            lines += _figures(value, f"{prefix}{name}.")
        else:
            lines.append((prefix + name, short(value)))
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)
