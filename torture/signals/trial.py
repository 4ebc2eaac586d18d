# SPDX-License-Identifier: Apache-2.0

"""A skin whose nodes or line break in episodes, and a judge of what its driver publishes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.stuck import StuckNodes
from tactile_cdma.readings.taxels import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.disturbance import Waveform
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import SimOptions

from ..oracle import Oracle, pressures
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
    so they must where words have parity. range_v: of
    the amplifier, 0: its default. timings: of the skins that it is tried on. told: names of what
    nobody can avoid then, which is told and not counted (see WordTally).
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
    told: tuple[str, ...] = ()

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
        options: dict[str, Value] = {"speed": 0, "seed": seed, "heartbeat": 20, "rail": range_v}
        return SimOptions(**options | dict(self.options))  # type: ignore[arg-type]


@dataclass
class Faults:
    """A Disturbance of one kind. number: of the frame that was made last."""

    kind: Kind
    skin: Skin
    seed: int
    number: int = -1

    def added(self, frame: NodeFrame, edges_s: NDArray[np.float64]) -> Iterator[Waveform]:
        """What broken nodes transmit, minus what they should."""
        self.number, spec = frame.number, self.skin.config.spec
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
        self.number, spec = frame.number, self.skin.config.spec
        episode = self.kind.episode(frame.number)
        if self.kind.line is None or episode is None or not volts.size:
            return volts
        life, chance = self._chances(episode, frame.number, spec.nodes)
        unit_v = spec.node_swing_v or 0.3
        peak_v = 4 * np.sqrt(spec.nodes) * unit_v
        since_s = t_s - self.kind.begin(episode) * spec.frame_period_s
        line = Span(volts, since_s, spec.frame_s, unit_v, peak_v, life, chance)
        return self.kind.line(line)

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
    phantoms: words of sound nodes that were silent, without a flag. doubted: wrong ones with one.
    cautious: right ones with a flag. missed: words of sound nodes that a published frame lacks.
    victims: wrong words without a flag on the rows of broken nodes' victims.
    hangs: episodes after which frames did not come again in time.
    unnoticed: broken nodes that were not found out. noticed: frames that it took, of the others.
    cost: of every skin, mean time of decoding a frame with the fault over that of a sound one.
    """

    faulty: int = 0
    published: int = 0
    words: int = 0
    wrong: int = 0
    phantoms: int = 0
    doubted: int = 0
    cautious: int = 0
    missed: int = 0
    victims: int = 0
    unnoticed: int = 0
    noticed: list[int] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)


class Trial:
    """One skin under one kind of fault."""

    def __init__(self, kind: Kind, skin: Skin, seed: int) -> None:
        self.kind, self.skin = kind, skin
        self.faults = Faults(kind, skin, seed)
        self.tally = WordTally()
        self._pipeline = Pipeline(skin.config, background=False)
        self._oracle = Oracle()
        options = skin.simulator(seed, kind.range_v)
        self._digitizer = VirtualDigitizer(options, disturbance=self.faults)
        self._pressure_of = pressures(skin.config)
        self._stuck = StuckNodes(skin.config.layout)
        self._complete: dict[int, bool] = {}  # number: whether it has all words of sound nodes
        self._last: dict[int, int] = {}  # episode: its frame that was published last, from 0 on
        self._found: dict[tuple[int, int], int] = {}  # episode, node: frame that told
        self._codes = np.full(skin.config.spec.nodes, UNKNOWN)  # last published
        self._spent: tuple[list[float], list[float]] = ([], [])  # s for a frame: sound, with fault

    def run(self, episodes: int) -> WordTally:
        """Run this many episodes."""
        spec, digitizer = self.skin.config.spec, self._digitizer
        digitizer.receive(Session(self.skin.config).open())
        self._oracle.began(digitizer.options, digitizer.setup, digitizer.started_s)
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
        sound, doubt = ~broken & ~victims, (frame.readings.status & DOUBT) != 0
        wrong = verdict.wrong | (~doubt & self._misread(frame))
        true = self._oracle.streams[verdict.stream].frame_at(frame.t_start)
        phantom = verdict.wrong & sound & ~doubt & ~(true is not None and true.active)
        tally.words += int((frame.words.active & sound).sum())
        tally.phantoms += int(phantom.sum())
        tally.wrong += int((wrong & sound & ~doubt & ~phantom).sum())
        tally.doubted += int((wrong & sound & doubt).sum())
        tally.cautious += int((frame.words.active & ~wrong & sound & doubt).sum())
        tally.victims += int((wrong & victims & ~doubt).sum())
        tally.missed += int((verdict.missed & sound).sum())
        self._complete[number] = not (verdict.missed & sound).any()
        np.copyto(self._codes, frame.words.codes, where=frame.words.active)
        self._codes[broken | victims] = UNKNOWN

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
