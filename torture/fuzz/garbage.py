# SPDX-License-Identifier: Apache-2.0

"""Endless garbage for a pipeline, and how much memory it holds of it."""

from __future__ import annotations

import random
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np

from tactile_cdma.config.parameters import GAP, LINE
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire._protocol import MAX_SAMPLES
from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketWriter, wrap
from test.support.simulated import introduction

CHUNK = 1 << 16
"""Bytes fed at once."""
MOST_HELD = 16 << 20
"""Most memory of a pipeline, including the processing of a chunk, bytes."""
Garbage = Callable[[random.Random], Iterator[bytes]]


def _same(chunk: bytes) -> Garbage:
    def endless(rng: random.Random) -> Iterator[bytes]:
        while True:
            yield chunk

    return endless


def _noise(rng: random.Random) -> Iterator[bytes]:
    while True:
        yield rng.randbytes(CHUNK)


def _bodies(rng: random.Random) -> Iterator[bytes]:
    """Intact packets of any type with any content."""
    while True:
        yield b"".join(wrap(rng.randbytes(rng.randint(1, 100))) for _ in range(256))


def _samples(place: str) -> Garbage:
    """Intact packets of noise on the line."""

    def endless(rng: random.Random) -> Iterator[bytes]:
        writer, index = PacketWriter(), 0
        noise = np.random.default_rng(rng.getrandbits(32))
        for number in count():
            volts = noise.normal(0, 2000, MAX_SAMPLES).astype(np.int16)
            if place == "anywhere":
                index = rng.getrandbits(64)
            time_us = rng.getrandbits(60) if place == "anywhere" else round(index / RATE_HZ * 1e6)
            marked = place == "marked" or (place == "anywhere" and number % 2 == 0)
            yield writer.encode(Samples(time_us, index, volts, sync=marked))
            index += MAX_SAMPLES

    return endless


def _quiet(rng: random.Random) -> Iterator[bytes]:
    writer, index = PacketWriter(), 0
    while True:
        index += rng.randint(1, 500)
        time_us = round(index / RATE_HZ * 1e6)
        yield writer.encode(Quiet(time_us, index, rng.randint(1, 900), 0, 0, sync=True))


KINDS: dict[str, tuple[str, Garbage]] = {
    "zeros": (LINE, _same(bytes(CHUNK))),
    "ones": (LINE, _same(b"\xff" * CHUNK)),
    "text": (LINE, _same(b"reading 1.25 V\r\n" * (CHUNK // 16))),
    "noise": (LINE, _noise),
    "intact packets of nonsense": (LINE, _bodies),
    "samples without marks": (LINE, _samples("unmarked")),
    "samples that are all marked": (LINE, _samples("marked")),
    "samples of any place and time": (LINE, _samples("anywhere")),
    "quiet frames of any length": (LINE, _quiet),
    "samples of noise without gaps": (GAP, _samples("unmarked")),
}
"""Timing parameter of the driver, and the garbage for it."""
CONFIGS = {timing: SkinConfig.of({"timing": timing}) for timing in (LINE, GAP)}
RATE_HZ = CONFIGS[LINE].samples_per_chip / CONFIGS[LINE].spec.chip_s


@dataclass(frozen=True, slots=True)
class Held:
    """fed: bytes fed. most: peak growth of memory meanwhile, bytes."""

    fed: int
    most: int


def feed(kind: str, seed: int, most_bytes: int, most_s: float, pipeline: Pipeline) -> Held:
    """Feed INFO, then garbage up to most_bytes or most_s of processor time."""
    pipeline.feed(PacketWriter().encode(introduction(pipeline.config)), 0.0)
    chunks, fed = KINDS[kind][1](random.Random(seed)), 0
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    until_s = time.thread_time() + most_s
    while fed < most_bytes and time.thread_time() < until_s:
        data = next(chunks)
        pipeline.feed(data, fed * 1e-6)
        fed += len(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return Held(fed, peak - before)


def pipeline_for(kind: str) -> Pipeline:
    """The pipeline that this kind of garbage is meant for."""
    return Pipeline(CONFIGS[KINDS[kind][0]])
