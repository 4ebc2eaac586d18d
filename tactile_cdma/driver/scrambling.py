# SPDX-License-Identifier: Apache-2.0

"""Finds nodes that scramble their chips while the parameters say that they do not, or the reverse.

A digitizer only repeats what the driver set it to; what nodes were written with shows on the line
alone. Where no word of a stream is certain, its bytes are decoded once more, the other way.
"""

from collections.abc import Iterable
from dataclasses import replace

from ..base.errors import SpecError
from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..wire.messages import FrameLayout, Info, Stretch
from ..wire.packets import PacketParser, PacketWriter
from .pipeline import Pipeline, TactileFrame

ENOUGH = 3
"""Frames with a certain word that prove the other way. Chosen: noise has none in millions."""
ODD_FRAMES = 24
"""Frames, rejected or in doubt, that are read before a stream is looked at, and in a look. Chosen:
some ten frames pass until the line at rest is known."""
LONGEST_S = 5.0
"""Longest time for which bytes of a stream are collected, s. Chosen: nodes at rest speak once a
second."""
PATIENCE = 10
"""Factor by which odd frames grow between two looks in vain. Chosen: an hour has four."""
_MISMATCHES = (
    "the nodes do not scramble their chips, but scramble is true: write their memories anew "
    "(tactile-cdma node), or set scramble to false",
    "the nodes scramble their chips, but scramble is false: set scramble to true",
)
"""What is wrong and what to do, by whether the nodes scramble."""


def mismatch(
    config: SkinConfig, chunks: Iterable[tuple[bytes, float]], info: Info | None = None
) -> str | None:
    """Says what is wrong, and what to do, if the stream has words the other way only; else None.

    chunks: bytes, and when they were read, of a stream of which no word is certain by `config`.
    info: what the digitizer said of itself before, where the bytes do not begin with that.
    """
    spec = config.spec
    if spec.sparse:
        return None
    try:
        # It may be wrong, too, but between gaps and of means it alone tells silence from words.
        is_needed = config.samples_per_chip == 1 or config.timing == GAP
        amplitude_v = spec.amplitude_v if is_needed else None
        other = replace(spec, scramble=not spec.scramble, amplitude_v=amplitude_v)
    except SpecError:  # there is only one way
        return None
    config = replace(config, spec=other)
    signs = FrameLayout.of(other, config.samples_per_chip).signs
    pipeline, parser, writer = Pipeline(config), PacketParser(), PacketWriter()
    understood, odd, started = 0, 0, [(info, 0.0)] if info else []
    received = ((packet, t_host) for data, t_host in chunks for packet in parser.feed(data))
    for packet, t_host in (*started, *received):
        if isinstance(packet, Info):
            packet = replace(packet, frame=replace(packet.frame, signs=signs))
        elif not isinstance(packet, Stretch):
            continue
        for frame in pipeline.feed(writer.encode(packet), t_host):
            understood += has_certain_word(frame)
            odd += not has_certain_word(frame) and bool(frame.words.doubtful.any())
        if understood >= ENOUGH:
            return _MISMATCHES[other.scramble]
        if odd + pipeline.rejections.total > ODD_FRAMES:
            return None
    return None


def has_certain_word(frame: TactileFrame) -> bool:
    """Whether a word of the frame is certain."""
    return bool((frame.words.active & ~frame.words.doubtful).any())


class ScrambleWatch:
    """Follows the stream of one connection until a word in it is certain.

    problem: that nodes scramble otherwise, as `mismatch` tells it, once that is known.
    listens: the bytes of the stream are wanted now. is_over: a word was certain, and nothing more
    is wanted.
    """

    def __init__(self, config: SkinConfig) -> None:
        self.problem: str | None = None
        self.listens = self.is_over = False
        self._config, self._doubted = config, 0
        self._chunks: list[tuple[bytes, float]] = []
        self._begin = self._end = ODD_FRAMES  # odd frames at which a look begins, and ends

    def hear(self, frame: TactileFrame) -> None:
        self._doubted += bool(frame.words.doubtful.any())
        if has_certain_word(frame):
            self.is_over, self.listens, self.problem = True, False, None
            self._chunks.clear()

    def note(self, data: bytes, t_host: float) -> None:
        """Take in bytes, while it listens."""
        self._chunks.append((data, t_host))

    def look(self, pipeline: Pipeline) -> bool:
        """Begin or end to listen, where that is due; returns whether a problem was found."""
        info, odd = pipeline.digitizer.info, self._doubted + pipeline.rejections.total
        if info is None or self.is_over:
            return False
        if not self.listens:
            self.listens, self._end = odd >= self._begin and not self.problem, odd + ODD_FRAMES
        elif self._chunks and (
            odd >= self._end or self._chunks[-1][1] - self._chunks[0][1] > LONGEST_S
        ):
            self.listens, self._begin = False, PATIENCE * odd
            self.problem = mismatch(self._config, self._chunks, info)
            self._chunks.clear()
            return self.problem is not None
        return False
