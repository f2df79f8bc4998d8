"""Commands in any order, at any time, over restarts: the engine stays consistent."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from cellctl.engine.phases import TRANSITIONS
from cellctl.errors import CellctlError
from cellctl.messages import State
from cellctl.store.history import ENDED, standing_of
from tests.core.toy import Bench, bench

PROCEDURES = {
    "asking": {},
    "fault": {"kind": "fault"},
    "wait": {"kind": "wait"},
    "late fault": {"kind": "late fault"},
    "bad input": {"kind": "bad input"},
    "look-up": {},
}

commands = st.one_of(
    st.tuples(st.just("start"), st.sampled_from(sorted(PROCEDURES))),
    st.tuples(st.just("cancel"), st.just("")),
    st.tuples(st.just("abandon"), st.integers(0, 3)),
    st.tuples(st.just("ack"), st.sampled_from(["ok", "red", "yes"])),
    st.tuples(st.just("resume"), st.integers(0, 3)),
    st.tuples(st.just("settle"), st.just("")),
    st.tuples(st.just("restart"), st.just("")),
)


@dataclass
class Story:
    """What was asked for so far: request id, procedure and run of each accepted trigger."""

    directory: Path
    accepted: list[tuple[str, str, str]] = field(default_factory=list)
    requests: int = 0


@settings(max_examples=40, deadline=None)
@given(st.lists(commands, max_size=14))
def test_any_order_of_commands(story):
    with tempfile.TemporaryDirectory() as directory:
        asyncio.run(tell(Story(Path(directory)), story))


async def tell(story, orders):
    lives: list[list[tuple[str, str | int]]] = [[]]
    for order in orders:
        if order[0] == "restart":
            lives.append([])
        else:
            lives[-1].append(order)
    for life in lives:
        async with watched(story.directory) as toy:
            assert toy.engine.state().phase in ("idle", "fault")
            for name, argument in life:
                with contextlib.suppress(CellctlError):  # a refusal in words is an answer
                    await obey(toy, story, name, argument)
                await repeat(toy, story)
                consistent(toy.engine.state())
    await look_back(story)


async def obey(toy: Bench, story: Story, name, argument) -> None:
    match name:
        case "start":
            story.requests += 1
            await trigger(toy, story, f"request-{story.requests}", argument)
        case "cancel":
            await toy.cancel()
        case "abandon" if story.accepted:
            await toy.cancel(story.accepted[argument % len(story.accepted)][2])
        case "ack":
            await toy.ack(argument)
        case "resume" if story.accepted:
            await toy.resume(story.accepted[argument % len(story.accepted)][2])
        case "settle":
            await asyncio.sleep(0.02)


async def trigger(toy: Bench, story: Story, request_id, kind) -> str:
    procedure = "troubled" if PROCEDURES[kind] else kind
    run_id = await toy.start(procedure, request_id, **PROCEDURES[kind])
    if all(known != request_id for known, _, _ in story.accepted):
        story.accepted.append((request_id, kind, run_id))
    return run_id


async def repeat(toy: Bench, story: Story) -> None:
    """Whatever goes on, a trigger that was accepted gives its run again."""
    for request_id, kind, run_id in story.accepted[-1:]:
        assert await trigger(toy, story, request_id, kind) == run_id


@contextlib.asynccontextmanager
async def watched(directory) -> AsyncIterator[Bench]:
    """A life of the engine in which every change of phase is one of the table's."""
    async with bench(directory) as toy:
        first = toy.engine.state().phase
        try:
            yield toy
        finally:
            await toy.engine.shutdown()
            phases = [first, *(m.phase for m in toy.seen if isinstance(m, State))]
            for before, after in itertools.pairwise(phases):
                legal = {to for (phase, _), to in TRANSITIONS.items() if phase == before}
                assert after == before or after in legal


def consistent(state: State) -> None:
    assert (state.active_run is None) == (state.phase in ("idle", "fault"))
    assert (state.question is not None) == (state.phase == "waiting")
    assert (state.fault is not None) == (state.phase == "fault")


async def look_back(story: Story) -> None:
    """On disk, every run that was accepted is there once, and none claims to be alive."""
    async with bench(story.directory) as toy:
        infos = {info.run_id: info for info in (await toy.engine.runs()).runs}
        assert set(infos) == {run_id for _, _, run_id in story.accepted}
        for run_id, info in infos.items():
            entries = toy.journal(run_id)
            assert standing_of(entries).status == info.status
            assert info.status in ENDED | {"interrupted"}
            ends = [entry.kind for entry in entries if entry.kind in ENDED]
            assert len(ends) <= 1, "a run ends for good only once"
            assert [entry.kind for entry in entries].count("started") == 1
