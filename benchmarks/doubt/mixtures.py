# SPDX-License-Identifier: Apache-2.0

"""Mixtures drawn at random: a skin of any order, how it talks, and one to four effects at once.

A mixture is given by its number, so that one that goes wrong can be looked at again; from MIXTURES
on, numbers are those of the same mixtures with scrambled skins:

    make bench-doubt ONLY="mixture 17:"

Effects set in at once, or somewhere in the recording. An effect is a function here that changes a
condition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from test.support.independent_line import Line, Skin, Talk

from ..report import QUICK
from .tally import Tally
from .words import TIMINGS, LineCondition

MIXTURES = 200
DRAWN, TWINS = (40, 20) if QUICK else (MIXTURES, MIXTURES)
"""How many mixtures run, and of how many of them the scrambled twins."""
ORDERS = (
    *(4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 60, 64, 68, 72),
    *(96, 100, 128, 144, 200, 256, 400, 512, 768, 1024),
)
RAIL_V, SWINGS = 6.0, 5.0
"""The converter's rails, and the sum of all nodes' words that they leave room for, sqrt(n) A."""
MOST_STEPS = 2_000_000
"""Chips of all nodes in one recording, which takes a second."""
LEAST_FRAMES, LEAST_SPEAK, MOST_SPEAK = 8, 10, 200
"""Frames of a recording, and nodes that transmit in one, where either would take longer. Fewer
nodes than LEAST_SPEAK take no less time to decode."""
WEAKEST, LEAST_RHO = 0.15, 4.0
"""Share of a node's amplitude, and its rho, below which docs/signal-model.md promises nothing."""
Draw: TypeAlias = np.random.Generator
Effect: TypeAlias = Callable[["Mixture", Draw], "Mixture"]


@dataclass(frozen=True)
class Mixture(LineCondition):
    """Is a condition with as many frames as its size allows."""

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """See LineCondition."""
        most = MOST_STEPS // (self.skin.chips * max(self.speakers, LEAST_SPEAK))
        return super().run(min(frames, max(LEAST_FRAMES, most)), seed)

    @property
    def speakers(self) -> int:
        """Return how many nodes transmit in a frame."""
        of = self.talk.speakers if isinstance(self.talk.speakers, int) else self.skin.nodes
        return self.talk.together or max(1, round(self.talk.share * of))

    @property
    def swing_v(self) -> float:
        """Amplitude of a node's code on the line, V."""
        return self.skin.amplitude_v / (2 if self.skin.drive == "unipolar" else 1)

    @property
    def bit_hz(self) -> float:
        return 1 / (self.skin.order * self.skin.chip_s)

    @property
    def weakest(self) -> float:
        """Return the share of its amplitude that a node needs, to be more than noise."""
        rho = math.sqrt(self.skin.order) * self.swing_v / self.line.noise_v
        return max(WEAKEST, LEAST_RHO / rho)

    def with_line(self, **changes: Any) -> Mixture:
        """Return this mixture with another line."""
        return replace(self, line=replace(self.line, **changes))

    def with_digitizer(self, **changes: Any) -> Mixture:
        """Return this mixture with another digitizer."""
        return replace(self, digitizer=replace(self.digitizer, **changes))

    def some(self, draw: Draw) -> list[int]:
        """Draw one to three nodes."""
        count = min(self.skin.nodes, int(draw.integers(1, 4)))
        return [int(node) for node in draw.choice(self.skin.nodes, count, replace=False)]


def between(draw: Draw, low: float, high: float) -> float:
    """Draw from numbers that span several octaves, each of which is as likely."""
    return float(math.exp(draw.uniform(math.log(low), math.log(high))))


# Effects


def hum(mixture: Mixture, draw: Draw) -> Mixture:
    """Mains, or a tone of a period that is not far from that of a bit."""
    hum_hz = float(draw.choice([50.0, 60.0, 400.0, mixture.bit_hz * between(draw, 0.05, 4)]))
    return mixture.with_line(hum_v=mixture.swing_v * between(draw, 0.2, 4), hum_hz=hum_hz)


def bursts(mixture: Mixture, draw: Draw) -> Mixture:
    """Ringing of some chips."""
    skin = mixture.skin
    return mixture.with_line(
        bursts_hz=between(draw, 0.05, 2) / (skin.chips * skin.chip_s),
        burst_v=mixture.swing_v * between(draw, 1, 10),
        burst_tone_hz=between(draw, 0.02, 1) / skin.chip_s,
        burst_s=skin.chip_s * between(draw, 1, 10),
    )


def spikes(mixture: Mixture, draw: Draw) -> Mixture:
    """Impulses of up to some chips."""
    skin = mixture.skin
    return mixture.with_line(
        impulses_hz=between(draw, 0.1, 10) / (skin.chips * skin.chip_s),
        impulse_v=mixture.swing_v * between(draw, 0.5, 20),
        impulse_chips=between(draw, 0.1, 4),
    )


def jumps(mixture: Mixture, draw: Draw) -> Mixture:
    """The level of the line changes."""
    skin = mixture.skin
    return mixture.with_line(
        steps_hz=between(draw, 0.05, 1) / (skin.chips * skin.chip_s),
        step_v=mixture.swing_v * between(draw, 0.3, 5),
    )


def drift(mixture: Mixture, draw: Draw) -> Mixture:
    """The level of the line moves, by up to three amplitudes in a frame."""
    skin = mixture.skin
    drift_v = mixture.swing_v * between(draw, 0.01, 3) * float(draw.choice([-1, 1]))
    return mixture.with_line(drift_v_per_s=drift_v / (skin.chips * skin.chip_s))


def offset(mixture: Mixture, draw: Draw) -> Mixture:
    """The line rests at another level."""
    return mixture.with_line(offset_v=mixture.swing_v * float(draw.uniform(-3, 3)))


def weak(mixture: Mixture, draw: Draw) -> Mixture:
    """Some nodes, or all, are not as loud as they should be."""
    if draw.random() < 0.3:
        return mixture.with_line(gain=between(draw, mixture.weakest, 1))
    return mixture.with_line(
        gains=tuple((node, between(draw, mixture.weakest, 1)) for node in mixture.some(draw))
    )


def loud(mixture: Mixture, draw: Draw) -> Mixture:
    """Some nodes are louder than they should be."""
    return mixture.with_line(
        gains=tuple((node, between(draw, 1.2, 4)) for node in mixture.some(draw))
    )


def late(mixture: Mixture, draw: Draw) -> Mixture:
    """Some nodes are late, or early."""
    return mixture.with_line(
        late=tuple((node, float(draw.uniform(-2.5, 2.5))) for node in mixture.some(draw))
    )


def drop_out(mixture: Mixture, draw: Draw) -> Mixture:
    """Some nodes stop within their words."""
    return mixture.with_line(dropouts=tuple((node, 0.3) for node in mixture.some(draw)))


def slow(mixture: Mixture, draw: Draw) -> Mixture:
    """Clocks of some nodes, or of all, are off."""
    if draw.random() < 0.3:
        return mixture.with_line(clock_error=float(draw.uniform(-3e-4, 3e-4)))
    chips = [float(draw.uniform(-3, 3)) for _ in range(3)]  # by the end of a frame
    nodes = mixture.some(draw)
    return mixture.with_line(
        slow=tuple((node, by / mixture.skin.chips) for node, by in zip(nodes, chips, strict=False))
    )


def edges(mixture: Mixture, draw: Draw) -> Mixture:
    """Edges are slow, ring or jitter."""
    kinds = {
        "low_pass_chips": (0.05, 0.6),
        "ringing": (0.1, 0.7),
        "edge_jitter_chips": (0.02, 0.2),
        "rise_chips": (0.1, 0.8),
        "skew_chips": (0.05, 0.5),
    }
    kind = str(draw.choice(list(kinds)))
    return mixture.with_line(**{kind: between(draw, *kinds[kind])})


def clipping(mixture: Mixture, draw: Draw) -> Mixture:
    """Amplifier or converter end before the sum of the nodes does."""
    most_v = mixture.skin.amplitude_v * math.sqrt(mixture.skin.nodes) * between(draw, 0.7, 3)
    if draw.random() < 0.5:
        return mixture.with_line(amplifier_v=most_v)
    return mixture.with_digitizer(rail_v=most_v)


def losses(mixture: Mixture, draw: Draw) -> Mixture:
    """Packets do not arrive, or samples are not in them."""
    if draw.random() < 0.5:
        return replace(mixture, lost=float(draw.uniform(0.02, 0.3)))
    skin = mixture.skin
    return mixture.with_digitizer(losses_hz=between(draw, 0.05, 1) / (skin.chips * skin.chip_s))


def marks(mixture: Mixture, draw: Draw) -> Mixture:
    """Marks are not where frames begin, or frames not where a raster says."""
    if mixture.digitizer.marked:
        shifts = tuple(0.25 * draw.choice([-8, -6, -4, -2, -1, 1, 2, 4, 6, 8], 2))
        return mixture.with_digitizer(mark_shifts=shifts)
    return mixture.with_line(start_jitter_chips=float(draw.uniform(0, 3)))


def slips(mixture: Mixture, draw: Draw) -> Mixture:
    """Samples are dropped or doubled, and nobody counts it."""
    return mixture.with_digitizer(slip_share=float(draw.uniform(0.05, 0.5)))


EFFECTS: tuple[Effect, ...] = (
    *(hum, bursts, spikes, jumps, drift, offset, weak, loud, late, drop_out, slow, edges),
    *(clipping, losses, marks, slips),
)


def conditions() -> Iterator[Mixture]:
    """Yield the first mixtures, and scrambled twins of those whose skins are plain and can be."""
    yield from map(mixture_of, range(DRAWN))
    for number in range(TWINS):
        if mixture_of(number).can_scramble:
            yield mixture_of(MIXTURES + number)


def mixture_of(number: int) -> Mixture:
    """Return the mixture of a number."""
    if number >= MIXTURES:
        _, _, effects = (plain := drawn(number - MIXTURES)).name.partition(":")
        return replace(plain, name=f"mixture {number}:{effects}").scrambled()
    return drawn(number)


def drawn(number: int) -> Mixture:
    """Draw a mixture by a seed."""
    draw = np.random.default_rng(number)
    timing = str(draw.choice(list(TIMINGS)))
    skin, count = draw_skin(draw), int(draw.integers(1, 5))
    swing_v = skin.amplitude_v / (2 if skin.drive == "unipolar" else 1)
    rho, gap = between(draw, 8, 100), between(draw, 0.2, 0.9)
    line = Line(
        noise_v=math.sqrt(skin.order) * swing_v / rho,
        onset=float(draw.choice([0.0, draw.uniform(0.1, 0.8)])),
    )
    chosen = draw.choice(len(EFFECTS), count, replace=False)
    mixture = Mixture(
        f"mixture {number}: {timing}, order {skin.order}, "
        + ", ".join(EFFECTS[effect].__name__.replace("_", " ") for effect in chosen),
        line,
        draw_talk(skin, draw),
        replace(skin, period_chips=float(round((1 + gap) * skin.chips + 8))),
        TIMINGS[timing],
        learnt=bool(draw.random() < 0.2),
        rough=True,
    )
    for effect in chosen:
        mixture = EFFECTS[effect](mixture, draw)
    return mixture


def draw_skin(draw: Draw) -> Skin:
    """Draw a skin of any order and word length, whose nodes' sum the converter has room for."""
    order, drive = int(draw.choice(ORDERS)), str(draw.choice(["bipolar"] * 5 + ["unipolar"]))
    bipolar = drive == "bipolar"
    first = int(not (bipolar and draw.random() < 0.2))
    nodes = order - first
    if draw.random() < 0.5:
        nodes = int(draw.integers(max(1, nodes // 2), nodes + 1))
    scramble = bool(bipolar and draw.random() < 0.3)
    return Skin(
        nodes=nodes,
        order=order,
        bits=int(draw.integers(8, 17)),
        parity=bool(draw.random() < 0.2),
        first_row=first,
        sign_seed=None if not scramble and draw.random() < 0.2 else int(draw.integers(2**32)),
        chip_s=1e-6 * int(between(draw, 2, 200)),
        amplitude_v=min(0.3, RAIL_V / (SWINGS * math.sqrt(nodes))),
        drive=drive,
        polarity=int(draw.choice([1, -1])),
        scramble=scramble,
    )


def draw_talk(skin: Skin, draw: Draw) -> Talk:
    """Draw who talks: all nodes at once, few, or those that have something to say."""
    words = str(draw.choice(["random", "random", "slow", "equal", "extreme"]))
    few, most = int(draw.integers(1, 4)), min(1.0, MOST_SPEAK / skin.nodes)
    kinds = (
        Talk(share=most, words=words),
        Talk(share=0.3 * most, stay=8, words=words),
        Talk(together=few if few < skin.nodes else 0, words=words),
        Talk(speakers=min(few, skin.nodes), words=words),
    )
    return kinds[int(draw.integers(len(kinds)))]
