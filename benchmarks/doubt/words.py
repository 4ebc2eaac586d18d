# SPDX-License-Identifier: Apache-2.0

"""Words of recordings of the independent line, decoded and compared with those that were sent."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.words import Words
from test.support.independent_line import (
    SILENT,
    Digitizer,
    Ints,
    Line,
    Recording,
    Skin,
    Talk,
    Truth,
    code_book,
    flips,
    render,
    row_sign,
)

from ..line_packets import config_of, introduction, packets
from .tally import Tally, total

Bools: TypeAlias = NDArray[np.bool_]

RAW = Digitizer()
MEANS = Digitizer(integrated=True, samples_per_chip=8)
BLIND = Digitizer(marked=False)
TIMINGS = {"marks": RAW, "means": MEANS, "gap": BLIND}
LOST, DAMAGED, REPEATED, LATE = "lost", "damaged", "repeated", "late"
"""What may become of packets."""
AT_RAIL = 0.5
"""Share of a frame's samples at a rail beyond which nobody can tell who was silent."""
LEARNING = 30
"""Frames until a decoder may know the raster of frame starts."""
MOST_SHIFT = 4
"""Chips by which another frame may be shifted to tie with the true one."""
LEAST_SCRAMBLED = 4
"""Least order that docs/signal-model.md lets be scrambled."""


@dataclass(frozen=True)
class LineCondition:
    """Puts the driver to a line, and says what it is told about that.

    learnt: the amplitude is not in the configuration. lost: share of the packets that do not
    arrive. rough: so disturbed that right words may be flagged, and lost.
    """

    name: str
    line: Line = Line()  # noqa: RUF009  (frozen)
    talk: Talk = Talk()  # noqa: RUF009
    skin: Skin = Skin()  # noqa: RUF009
    digitizer: Digitizer = RAW
    learnt: bool = False
    lost: float = 0.0
    rough: bool = False

    @property
    def most_speakers(self) -> int:
        """Return the number of nodes that may transmit in one frame."""
        talk, speakers = self.talk, self.talk.speakers
        if talk.together or not talk.share:
            return talk.together
        if speakers is None:
            return self.skin.nodes
        return speakers if isinstance(speakers, int) else len(speakers)

    @property
    def can_scramble(self) -> bool:
        """Return whether this is a plain skin that could be scrambled."""
        skin = self.skin
        seeded = skin.sign_seed is not None and not (skin.scramble or skin.sparse)
        return seeded and skin.drive == "bipolar" and skin.order >= LEAST_SCRAMBLED

    def scrambled(self) -> Self:
        """Return this condition with a scrambled skin; its recordings are drawn anew."""
        return replace(self, name=f"{self.name}, scrambled", skin=replace(self.skin, scramble=True))

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Render a recording, decode it and compare; also the first unflagged words."""
        seeds = [zlib.crc32(self.name.encode()), seed]
        recording = render(self.skin, self.talk, self.line, self.digitizer, frames, seeds)
        return compare(recording, decode(recording, self.learnt, self.lost, seed), self.line)


class Decoded(NamedTuple):
    """Is a frame as published: its start, chips, its words, and which nodes count as broken."""

    start_chips: float
    words: Words
    invalid: Bools


def decode(
    recording: Recording, learnt: bool = False, lost: float = 0.0, seed: int = 0
) -> list[Decoded]:
    """Return what the driver makes of a recording; see play."""
    chip_s = recording.skin.chip_s
    return [
        Decoded(frame.t_start / chip_s, frame.words, pipeline.health.invalid.copy())
        for frame, pipeline in play(recording, learnt, lost, seed)
    ]


def play(
    recording: Recording,
    learnt: bool = False,
    lost: float = 0.0,
    seed: int = 0,
    how: str = LOST,
    **parameters: float,
) -> Iterator[tuple[TactileFrame, Pipeline]]:
    """Yield the driver's frames of a recording, one by one, and what makes them.

    lost: share of the packets that do not arrive as they should, drawn by the seed. how: see
    arrivals. parameters: of the driver.
    """
    unknown = {"amplitude_mv": 0.0} if learnt else {}
    config = config_of(recording.skin, recording.digitizer, **unknown, **parameters)
    writer = PacketWriter()
    pipeline = Pipeline(config)
    pipeline.feed(writer.encode(introduction(config, recording.digitizer)), 0.0)
    if pipeline.problem:
        raise ValueError(pipeline.problem)
    for t_host, data in arrivals(packets(recording, writer), lost, how, seed):
        yield from ((frame, pipeline) for frame in pipeline.feed(data, t_host))
    yield from ((frame, pipeline) for frame in pipeline.flush())


def arrivals(
    sent: Iterable[tuple[float, float, bytes]], share: float, how: str, seed: int
) -> Iterator[tuple[float, bytes]]:
    """Host time and bytes of what arrives of packets.

    share: of them, drawn by the seed, are LOST, DAMAGED in a bit, REPEATED (the one before, in its
    place), or LATE by one.
    """
    lots, before, late = np.random.default_rng(seed), b"", b""
    for _, t_host, data in sent:
        is_hit, middle = lots.random() < share, len(data) // 2
        broken = {
            LOST: b"",
            DAMAGED: data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :],
            REPEATED: before,
            LATE: b"",
        }
        yield t_host, (broken[how] if is_hit else data) + late
        before, late = data, data if is_hit and how == LATE else b""


def compare(recording: Recording, decoded: list[Decoded], line: Line) -> tuple[Tally, list[str]]:
    """Count the words; also describe the first unflagged ones."""
    truths, never = recording.frames, recording.never
    starts = np.array([truth.start_chips for truth in truths])
    nearest = [int(np.argmin(np.abs(starts - frame.start_chips))) for frame in decoded]
    heard: dict[int, Decoded] = {}
    extra: list[Decoded] = []
    for number, frame in zip(nearest, decoded, strict=True):
        near = abs(starts[number] - frame.start_chips) < recording.skin.period_chips / 2
        other = heard.get(number)
        if not near:
            extra.append(frame)
        elif other is None or (_off(frame, truths[number]) < _off(other, truths[number])):
            extra += [other] if other else []
            heard[number] = frame
        else:
            extra.append(frame)
    moves = not recording.digitizer.marked and bool(line.start_jitter_chips or line.slip_share)
    tallies, complaints = [], []
    for number, truth in enumerate(truths):
        blind = not recording.digitizer.marked and (moves or number < LEARNING)
        tally = _count(
            truth, heard.get(number), blind and rival(recording.skin, truth.codes) is not None
        )
        tallies.append(tally)
        if tally.unflagged:
            complaints.append(_complaint(number, truth, heard[number]))
    for frame in extra:
        flagged = _flags(frame)
        invented = int(np.count_nonzero(frame.words.active & ~flagged))
        rest = int(np.count_nonzero(frame.words.active & flagged))
        tallies.append(Tally(invented=invented, wrong_flagged=rest))
        if invented:
            complaints.append(f"  no frame began near chip {frame.start_chips:.1f}")
    phantom = sum(
        int(np.count_nonzero(frame.words.active & never & ~_flags(frame))) for frame in decoded
    )
    rail_silent = sum(
        int(np.count_nonzero(~frame.words.active & ~_flags(frame)))
        for number, frame in zip(nearest, decoded, strict=True)
        if truths[number].clipped > AT_RAIL
    )
    return total(tallies)._replace(phantom=phantom, rail_silent=rail_silent), complaints


def _off(frame: Decoded, truth: Truth) -> tuple[bool, float]:
    """Return how badly a decoded frame fits a true one: silent ones last, then by the start."""
    spoke = bool((truth.codes != SILENT).any())
    return bool(frame.words.active.any()) != spoke, abs(frame.start_chips - truth.start_chips)


def _flags(frame: Decoded) -> Bools:
    """Return what is published as doubtful or broken, (n,)."""
    flags: Bools = frame.words.doubtful | frame.invalid
    return flags


def _count(truth: Truth, frame: Decoded | None, tie: bool) -> Tally:
    """Count the words of one frame."""
    spoke = truth.codes != SILENT
    words = int(np.count_nonzero(spoke))
    if frame is None:
        return Tally(words=words, lost=words)
    flag, active = _flags(frame), frame.words.active
    same = spoke & active & (frame.words.codes == truth.codes)
    other = (spoke | active) & ~same
    count: dict[str, Any] = {
        "right": same & ~flag,
        "tied" if tie else "flagged": same & flag,
        "missed": other & ~active & ~flag,
        "wrong_flagged": other & flag,
        "wrong": other & active & spoke & ~flag,
        "invented": other & ~spoke & ~flag,
        "silences": ~spoke & ~active,
        "silent_flagged": ~spoke & ~active & flag & (not tie),
    }
    return Tally(words, **{name: int(np.count_nonzero(some)) for name, some in count.items()})


def _complaint(number: int, truth: Truth, frame: Decoded) -> str:
    """Describe one frame's unflagged words."""
    active, codes = frame.words.active, frame.words.codes
    told = np.where(active, codes, SILENT)
    wrong = np.flatnonzero((told != truth.codes) & ~_flags(frame))
    words = ", ".join(f"node {i} sent {truth.codes[i]} told {told[i]}" for i in wrong[:4])
    late = frame.start_chips - truth.start_chips
    return (
        f"  frame {number}, {late:+.2f} chips off, {np.sum(truth.codes != SILENT)} active, "
        f"{len(wrong)} unflagged: {words}"
    )


def rival(skin: Skin, codes: Ints) -> tuple[int, Ints] | None:
    """Another start, so many chips later, and the words that give exactly the same waveform there.

    Bipolar nodes without parity; None of others, and where there is no such pair.
    """
    if skin.parity:
        return None
    chips = skin.waveforms(codes).sum(axis=0) / skin.amplitude_v
    rows = np.arange(skin.first_row, skin.first_row + skin.nodes)
    signs = np.array([row_sign(int(row), skin.sign_seed) for row in rows])
    flipped = flips(skin.bits, skin.order, skin.sign_seed or 0) if skin.scramble else 1
    sent = skin.polarity * signs[:, None] * code_book(skin.order)[rows].astype(float)
    for shift in (*range(-MOST_SHIFT, 0), *range(1, MOST_SHIFT + 1)):
        cut = chips[:shift] if shift > 0 else chips[shift:]
        if not chips.any() or cut.any():
            continue
        moved = np.roll(chips, -shift).reshape(-1, skin.order) * flipped
        levels = moved @ sent.T / skin.order
        spoke = np.abs(levels).mean(axis=0) > 0.5
        if np.allclose(np.sign(levels) * spoke @ sent, moved):
            values = (levels > 0).T @ 2 ** np.arange(skin.bits - 1, -1, -1)
            return shift, np.where(spoke, values, SILENT)
    return None
