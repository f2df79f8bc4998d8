"""A Gray code on the free table: shown slide by slide, recorded, and read when all were taken."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from cellctl.calib.corners import grey
from cellctl.calib.dense import CodeSeen, read_code
from cellctl.calib.graycode import GrayCode
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.errors import BadInput
from cellctl.procedures.capture import grab_still, mean_image
from cellctl.procedures.record import Record, Samples
from cellctl.run import Run

SLIDES, READ, CODE = "slides", "read", "code"
FRAMES = 2
READ_TIMEOUT_S = 300.0


def code_of(config: CellConfig, stripe_px: int) -> GrayCode:
    """Whose finest stripes are at least `stripe_px` wide: finer ones the camera cannot resolve."""
    finest = max((stripe_px - 1).bit_length() - 1, 0)
    width, height = config.projector.size_px
    return GrayCode.of(
        (width, height),
        column_bits=(width - 1).bit_length() - finest,
        row_bits=(height - 1).bit_length() - finest,
    )


async def take(run: Run, cell: Cell, stripe_px: int) -> None:
    """Show and record all slides, then read them."""
    code = code_of(cell.config, stripe_px)
    await run.step(SLIDES, len(code.slides))
    for i, slide in enumerate(code.slides):
        key = _key(i)
        if key in run.samples():
            continue
        await run.checkpoint(f"{key} is shown")
        async with run.taking(key):
            on_glass = await cell.projector.show(code.picture(slide))
            frames = await grab_still(cell, on_glass, FRAMES)
            image = await asyncio.to_thread(mean_image, frames)
        await run.sample(key, {}, {"image": image})
        run.progress(i + 1)
    slides = run.samples(SLIDES)
    await run.step(READ, 1)
    if CODE not in run.samples():
        read = await run.call(read_slides, slides, code, timeout_s=READ_TIMEOUT_S)
        await run.sample(CODE, read.to_dict())


def seen(record: Record[Any], stripe_px: int) -> CodeSeen:
    """What was read when the slides were taken, or is read now if `record.again`. BadInput when
    they are not all there."""
    if record.again:
        return read_slides(record.samples(SLIDES), code_of(record.config, stripe_px))
    return CodeSeen.from_dict(record.samples(READ)[CODE].data)


def read_slides(samples: Samples, code: GrayCode) -> CodeSeen:
    """Pure: from the recorded pictures."""
    return read_code(_Recorded(samples, len(code.slides)), code)


class _Recorded(Sequence[Any]):
    """Recorded pictures, grey, loaded when they are asked for: all at once would be hundreds of
    megabytes."""

    def __init__(self, samples: Samples, count: int) -> None:
        missing = [_key(i) for i in range(count) if _key(i) not in samples]
        if missing:
            raise BadInput(f"the code is not complete: {', '.join(missing[:3])} was not recorded")
        self._samples, self._count = samples, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        return grey(self._samples[_key(index)].images["image"].load())


def _key(index: int) -> str:
    return f"slide-{index:02d}"
