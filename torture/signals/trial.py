# SPDX-License-Identifier: Apache-2.0

"""A skin whose nodes or line break in episodes, and a judge of what its driver publishes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.stuck import StuckNodes
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import Waveform
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.words.health import WEAK_SHARE
from test.support.oracle import Oracle, pressures

from ..outcome import Tally
from . import faulty_line, faulty_nodes
from .faulty_line import Span
from .faulty_nodes import Turn, spoken

LINE, CHIPS, GAP = "line", "chips", "gap"
"""Kinds of skins: marked frames of raw samples, of chip means, and frames found by their gaps."""
WARM_UP = 34
"""Sound frames before the first fault."""
RECOVERY = 2
"""Frames after an episode that may still be lost."""
SEEN = 0.75
"""Broken nodes must be flagged if frames are published after this share of an episode."""
LOST_SHARE = WEAK_SHARE
"""A word of which less reached the converter cannot be held against the decoder: with less than
that it may take a node for silent (docs/signal-model.md)."""
UNKNOWN = -1
"""Code of a node that has not been published since it was broken."""
BLAME = Status.WEAK | Status.FAULTY | Status.STALE
"""Flags of broken nodes."""
DOUBT = Status.LOW_SNR | Status.FAULTY | Status.STALE
"""Flags of unreliable readings."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    nodes: what so many (`count`) nodes say instead of their words; with `victims` each disturbs one
    other in particular. line: what becomes of the line. length, pause: frames that it lasts, and
    that follow in order. flagged: the nodes must be found out within `length` frames; parity_tells:
    so they must where words have parity. range_v: of the amplifier, 0: its default. timings: of
    the skins that it is tried on.
    """

    name: str
    nodes: faulty_nodes.Broken | None = None
    line: faulty_line.Broken | None = None
    count: int = 1
    victims: bool = False
    length: int = 100
    pause: int = 16
    flagged: bool = True
    parity_tells: bool = False
    range_v: float = 0.0
    timings: tuple[str, ...] = (LINE, CHIPS, GAP)

    def episode(self, number: int) -> int | None:
        """Index of the episode that a frame belongs to; None: the frame is sound."""
        turn, place = divmod(number - WARM_UP, self.length + self.pause)
        return turn if turn >= 0 and place < self.length else None

    def begin(self, episode: int) -> int:
        """The number of an episode's first frame."""
        return WARM_UP + episode * (self.length + self.pause)


@dataclass(frozen=True)
class Skin:
    """Parameters of a driver and options of its simulator. timing: LINE, CHIPS or GAP."""

    timing: str
    values: Mapping[str, Value]
    options: Mapping[str, Value] = field(default_factory=dict)

    @cached_property
    def config(self) -> SkinConfig:
        """The driver's; drift is not followed, so that a word has one pressure."""
        values: dict[str, Value] = {"drift_pa_per_min": 0.0, "stale_after_s": 0.8}
        if self.timing == CHIPS:
            values["samples_per_chip"] = 1
        values["timing"] = "gap" if self.timing == GAP else "line"
        return SkinConfig.of(values | dict(self.values))

    def simulator(self, seed: int, range_v: float) -> SimOptions:
        """The simulator's."""
        options: dict[str, Value] = {"scene": "moving", "speed": 0, "seed": seed}
        options |= {"heartbeat": 20, "rail": range_v}
        return SimOptions(**options | dict(self.options))  # type: ignore[arg-type]


@dataclass
class Faults:
    """A Disturbance of one kind.

    rail_v: the converter's largest voltage, either way. number: of the frame that was made last.
    """

    kind: Kind
    skin: Skin
    seed: int
    rail_v: float = np.inf
    number: int = -1
    _edges_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    _lines: dict[int, NDArray[np.float32]] = field(default_factory=dict)

    def added(self, frame: NodeFrame, edges_s: NDArray[np.float64]) -> Iterator[Waveform]:
        """What broken nodes transmit, minus what they should."""
        self.number, spec, self._edges_s = frame.number, self.skin.config.spec, edges_s
        episode = self.kind.episode(frame.number)
        if self.kind.nodes is None or episode is None:
            return
        for node, other in self.chosen(episode):
            code = int(frame.codes[node]) if frame.active[node] else None
            life, chance = self._chances(episode, frame.number, node)
            turn = Turn(spec, node, other, code, edges_s, life, chance)
            if code is not None:
                yield -spoken(spec, code, turn.row), edges_s
            yield from self.kind.nodes(turn)

    def disturbed(
        self, frame: NodeFrame, volts: NDArray[np.float32], t_s: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """The line with the fault."""
        kind, spec, episode = self.kind, self.skin.config.spec, self.kind.episode(frame.number)
        if kind.line is not None and episode is not None and volts.size:
            life, chance = self._chances(episode, frame.number, spec.nodes)
            unit_v = spec.node_swing_v or 0.3
            peak_v = 4 * np.sqrt(spec.nodes) * unit_v
            since_s = t_s - kind.begin(episode) * spec.frame_period_s
            volts = kind.line(Span(volts, since_s, spec.frame_s, unit_v, peak_v, life, chance))
        self._keep_line(frame.number, volts, t_s)
        return volts

    def heard_share(self, number: int, node: int, code: int) -> float:
        """How much of a node's word reached the converter in a frame: 1 of a sound one, 0 of none.

        The mean over its bits of the share of its amplitude, in the right chips and with the right
        sign, each limited to 0…1 so that a spike in one bit says nothing about the others. No
        decoder knows that much.
        """
        spec, line = self.skin.config.spec, self._lines[number]
        shape = spec.line_bits, spec.order
        word = spoken(spec, code, spec.first_row + node)[spec.places].reshape(shape)
        row = word - word.mean(axis=1, keepdims=True)
        shares = (line.reshape(shape) * row).sum(axis=1) / (row * row).sum(axis=1)
        return float(np.clip(shares, 0, 1).mean())

    def _keep_line(self, number: int, volts: NDArray[np.float32], t_s: NDArray[np.float64]) -> None:
        """Keep the mean of every coded chip of a frame."""
        spec, volts = self.skin.config.spec, np.clip(volts, -self.rail_v, self.rail_v)
        if self.skin.timing != CHIPS:
            inside = (t_s >= self._edges_s[0]) & (t_s < self._edges_s[-1])
            chip = np.searchsorted(self._edges_s, t_s[inside], side="right") - 1
            sums = np.bincount(chip, volts[inside], spec.span_chips)
            samples = np.bincount(chip, minlength=spec.span_chips)
            volts = (sums / np.maximum(samples, 1)).astype(np.float32)[spec.places]
        self._lines[number] = volts

    def forget(self, until: int) -> None:
        """Drop the lines of frames before this one."""
        self._lines = {number: line for number, line in self._lines.items() if number >= until}

    def chosen(self, episode: int) -> list[tuple[int, int]]:
        """Indices of the broken nodes, each with that of a sound one."""
        if self.kind.nodes is None:
            return []
        order = np.random.default_rng([self.seed, episode]).permutation(self.skin.config.spec.nodes)
        count = min(self.kind.count, len(order) // 2)
        return list(zip(order[:count].tolist(), order[count : 2 * count].tolist(), strict=True))

    def concerned(self, episode: int) -> NDArray[np.intp]:
        """The nodes that are broken, and their victims."""
        pairs = np.array(self.chosen(episode), dtype=np.intp).reshape(-1, 2)
        return pairs.ravel() if self.kind.victims else pairs[:, 0]

    def _chances(
        self, episode: int, number: int, node: int
    ) -> tuple[np.random.Generator, np.random.Generator]:
        seeds = [self.seed, 1, episode, node], [self.seed, 2, number, node]
        return np.random.default_rng(seeds[0]), np.random.default_rng(seeds[1])


@dataclass
class WordTally(Tally):
    """A Tally of words, by what they can be wrong in.

    times: episodes of the fault. faulty, published: frames with the fault; those of them published.
    words: of sound nodes, published. wrong: of these without a flag, not what was said.
    invented: words of sound nodes that were silent, without a flag. doubted: wrong ones with one.
    cautious: right ones with a flag. missed: words of sound nodes that were heard at the converter,
        and that a published frame lacks without a flag. unheard: those that were not.
    broken: wrong words of the broken nodes themselves, without a flag; they are told and not
        counted, as what is on the line is well-formed.
    hangs: episodes after which frames did not come again in time.
    unnoticed: broken nodes that were not found out. noticed: frames that it took, of the others.
    cost: of every skin, mean time of decoding a frame with the fault over that of a sound one.
    """

    faulty: int = 0
    published: int = 0
    words: int = 0
    wrong: int = 0
    invented: int = 0
    doubted: int = 0
    cautious: int = 0
    missed: int = 0
    unheard: int = 0
    broken: int = 0
    unnoticed: int = 0
    noticed: list[int] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)


class Trial:
    """One skin under one kind of fault."""

    def __init__(self, kind: Kind, skin: Skin, seed: int) -> None:
        self.kind, self.skin = kind, skin
        self.faults = Faults(kind, skin, seed)
        self.tally = WordTally()
        self._pipeline = Pipeline(skin.config)
        self._oracle = Oracle()
        options = skin.simulator(seed, kind.range_v)
        self._digitizer = VirtualDigitizer(options, disturbance=self.faults)
        self.faults.rail_v = options.channel.rail_of(skin.config.spec)
        self._pressure_of = pressures(skin.config)
        self._stuck = StuckNodes(skin.config.layout)
        self._complete: dict[int, bool] = {}  # number: whether it has all words of sound nodes
        self._last: dict[int, int] = {}  # episode: its frame that was published last, from 0 on
        self._found: dict[tuple[int, int], int] = {}  # episode, node: frame that told
        self._codes = np.full(skin.config.spec.nodes, UNKNOWN)  # last published
        self._heard_s = np.full(skin.config.spec.nodes, -np.inf)  # device time of that
        self._spent: tuple[list[float], list[float]] = ([], [])  # s for a frame: sound, with fault

    def run(self, episodes: int) -> WordTally:
        """Run this many episodes."""
        spec, digitizer = self.skin.config.spec, self._digitizer
        digitizer.receive(Session(self.skin.config).open())
        self._oracle.began(digitizer.options, digitizer.setup, digitizer.started_s, digitizer.turns)
        size = 2 * round(spec.frame_period_s * digitizer.setup.rate_hz)
        until = self.kind.begin(episodes)
        while self.faults.number < until:
            digitizer.advance(size)
            faulty = self.kind.episode(self.faults.number) is not None
            data, t_host = digitizer.take(size), self.faults.number * spec.frame_period_s
            before_s = thread_time()
            frames = self._pipeline.feed(data, t_host)
            self._spent[faulty].append(thread_time() - before_s)
            for frame in frames:
                self._judge(frame, until - self.kind.pause // 4)
        self._sum_up(episodes)
        return self.tally

    def _judge(self, frame: TactileFrame, until: int) -> None:
        verdict, tally = self._oracle.check(frame), self.tally
        tally.uncounted_losses += verdict.uncounted
        number = verdict.number
        if number is None:
            doubt = (frame.readings.status & DOUBT) != 0
            tally.wrong += int((verdict.wrong & ~doubt).sum())
            tally.doubted += int((verdict.wrong & doubt).sum())
            return
        if number >= until:
            return
        self._stuck.look(frame.readings, frame.t_middle, self.skin.config.rest.contact_pa)
        episode = self.kind.episode(number)
        broken, victims = np.zeros((2, len(verdict.wrong)), dtype=bool)
        if episode is not None:
            broken[[node for node, _ in self.faults.chosen(episode)]] = True
            victims[self.faults.concerned(episode)] = True
            victims &= ~broken
            tally.published += 1
            self._last[episode] = number - self.kind.begin(episode)
            self._look(frame, number, episode)
        spoke, doubt = frame.words.active, (frame.readings.status & DOUBT) != 0
        true = self._oracle.streams[verdict.stream].frame_at(frame.t_start)
        assert true is not None  # the verdict has its number
        missed = verdict.missed & ~broken
        if episode is not None and self.kind.victims:
            verdict = replace(verdict, wrong=verdict.wrong & ~self._from_another(frame, true))
        wrong = verdict.wrong | (~doubt & self._misread(frame))
        invented = verdict.wrong & ~broken & ~doubt & ~true.active
        tally.words += int((spoke & ~broken).sum())
        tally.invented += int(invented.sum())
        tally.wrong += int((wrong & ~broken & ~doubt & ~invented & ~missed).sum())
        tally.doubted += int((wrong & ~broken & doubt).sum())
        tally.cautious += int((spoke & ~wrong & ~broken & doubt).sum())
        tally.broken += int((wrong & broken & ~doubt).sum())
        unheard = self._unheard(true, missed & ~doubt, frame.t_middle)
        tally.unheard += int(unheard.sum())
        tally.missed += int((missed & ~doubt & ~unheard).sum())
        self.faults.forget(number)
        self._complete[number] = not missed.any()
        np.copyto(self._codes, frame.words.codes, where=spoke)
        np.copyto(self._heard_s, frame.t_middle, where=spoke)
        self._codes[broken | victims] = UNKNOWN

    def _from_another(self, frame: TactileFrame, true: NodeFrame) -> NDArray[np.bool_]:
        """(n,) bool: victims in whose silence the node that speaks on their row is read."""
        episode, found = self.kind.episode(true.number), np.zeros(len(true.codes), dtype=bool)
        for node, victim in self.faults.chosen(episode or 0):
            alone = true.active[node] and not true.active[victim]
            found[victim] = alone and frame.words.codes[victim] == true.codes[node]
        return found

    def _unheard(
        self, true: NodeFrame, missed: NDArray[np.bool_], t_middle: float
    ) -> NDArray[np.bool_]:
        """(n,) bool: missed words of which too little reached the converter.

        Only until the node has to be stale: then nothing excuses a value without a flag.
        """
        found = missed & (t_middle - self._heard_s <= self.skin.config.stale_after_s)
        for node in np.flatnonzero(found).tolist():
            share = self.faults.heard_share(true.number, node, int(true.codes[node]))
            found[node] = share < LOST_SHARE
        return found

    def _misread(self, frame: TactileFrame) -> NDArray[np.bool_]:
        """(n,) bool: nodes whose reading is not that of their last published word."""
        config, words, readings = self.skin.config, frame.words, frame.readings
        codes = np.where(words.active, words.codes, self._codes)
        voltage_v = config.adc.voltage(np.maximum(codes, 0)).astype(np.float32)
        pressure_pa = self._pressure_of[np.arange(len(codes)), codes]
        near = np.isclose(readings.pressure_pa, pressure_pa, rtol=1e-4, atol=1.0)
        right = (readings.voltage_v == voltage_v) & near
        wrong: NDArray[np.bool_] = ~right & (codes != UNKNOWN)
        return wrong

    def _look(self, frame: TactileFrame, number: int, episode: int) -> None:
        """Note which broken nodes are flagged."""
        stuck = self._stuck.nodes
        for node, _ in self.faults.chosen(episode):
            if frame.readings.status[node] & BLAME or node + 1 in stuck:
                self._found.setdefault((episode, node), number - self.kind.begin(episode))

    def _sum_up(self, episodes: int) -> None:
        kind, tally = self.kind, self.tally
        tally.times, tally.faulty = episodes, episodes * kind.length
        for episode in range(episodes):
            over = kind.begin(episode) + kind.length
            due = range(over + RECOVERY, over + kind.pause - kind.pause // 4)
            tally.hangs += not all(self._complete.get(number, False) for number in due)
            found = [self._found.get((episode, n)) for n, _ in self.faults.chosen(episode)]
            tally.noticed += [frames for frames in found if frames is not None]
            if self._last.get(episode, -1) + 1 > SEEN * kind.length:
                tally.unnoticed += found.count(None)
        sound_s, faulty_s = self._spent
        if faulty_s:
            tally.cost.append(float(np.mean(faulty_s) / np.mean(sound_s)))
