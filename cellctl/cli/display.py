"""Follow a run on stderr: a bar on a terminal, a line for each step elsewhere."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Self

from cellctl.bus.client import Client
from cellctl.bus.follow import Link, Update
from cellctl.cli import words
from cellctl.cli.output import err, note, out, say
from cellctl.messages import Event, Progress, RunInfo, State

if TYPE_CHECKING:
    import rich.progress

TOLD = ("started", "resumed", "step", "question")


class ProgressBar:
    """Shows how far a run is, if stderr is a terminal. A context manager."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._bar: rich.progress.Progress | None = None

    def __enter__(self) -> Self:
        if err.is_terminal:
            self._bar = self._open.enter_context(_bar())
            self._task = self._bar.add_task("", total=None, visible=False)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def show(self, update: Update) -> None:
        """Whatever says something about progress; other updates are ignored."""
        if self._bar is None:
            return
        progress = update.progress if isinstance(update, State | RunInfo) else update
        if isinstance(progress, Progress):
            self._bar.update(
                self._task,
                description=f"{progress.step} {progress.text}".strip(),
                completed=progress.done,
                total=progress.total or None,
                visible=True,
            )
        elif isinstance(update, Event) and update.kind == "ended":
            self._bar.update(self._task, visible=False)

    def say(self, text: str) -> None:
        """A line of the result, above the bar if both are on one terminal."""
        if self._bar is not None and out.is_terminal:
            note(text)
        else:
            say(text)


def _bar() -> rich.progress.Progress:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=err,
        transient=True,
        redirect_stdout=False,  # else what belongs on stdout would be printed on stderr
    )


def follow(client: Client, run_id: str, give_up_s: float | None = None) -> RunInfo:
    """Show a run until it ends or is interrupted; Unreachable as of `Client.watch`."""
    with ProgressBar() as bar:
        for update in client.watch(run_id, give_up_s=give_up_s):
            if isinstance(update, RunInfo):
                return update
            bar.show(update)
            _tell(update)
    raise AssertionError("watching a run ends with its RunInfo")


def _tell(update: Update) -> None:
    if isinstance(update, Event) and update.kind in TOLD:
        note(words.event(update, of_one_run=True))
        for choice in update.data.get("choices", []):
            note(f"  to answer: {words.answer_command(str(choice), update.data.get('id'))}")
    elif isinstance(update, Link):
        note(words.link(update))
