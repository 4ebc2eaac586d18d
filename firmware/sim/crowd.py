# SPDX-License-Identifier: Apache-2.0

"""Thousands of nodes with sparse codes on one wire: `make firmware-thousand NODES=4000`.

    images of the fast node (simavr) → pins → analog line → the RP2040's image → USB → driver

A share of the nodes is pressed at random, another in every frame; then 300 at once (a hug); then
all. That is more than a frame holds, so the driver asks the digitizer for groups, and all are heard
by turns. Nodes are told from the rules of docs/protocol.md, frame by frame: what each has to say,
and when; every word and every silence of a frame that is certain is compared with that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from losses import LossyDriver
from rp2040_skin import Rp2040Skin
from skin import CRYSTALS, Spread, reference_amplifier, reference_nodes
from tactile_cdma.base.arrays import Bools
from tactile_cdma.config.frame_rate import FAST
from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.framing.load import capacity
from tactile_cdma.hardware.node_memory import usual_heartbeat
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketParser
from tactile_cdma.words.groups import FULL

Codes = NDArray[np.int64]

REST_CODE = 1000
"""Code of a node at rest. Chosen: near the usual curve's 0 kPa."""
THRESHOLD = 1
SETTLING = 14
"""First frames: nodes measure two periods of the sync line, the host the line's noise in eight."""
PRESSED_SHARE = 0.04
"""Share of the nodes that is pressed in a frame; as many are released: 8 % speak."""
HUG, HUG_FRAMES, RANDOM_FRAMES = 300, 4, 8
WAY = 4
"""Frames until there are groups: those that tell that it is too many, and the command's way."""
QUICK = 600
"""Images of a quick run: more than a frame holds."""
CLOCK_KNOWN = 2
"""Frames in which a node measures its clock before it transmits."""
LOSE_EVERY = 9
"""Frames, one of which is lost to a second driver."""
COMMANDED_NS = 2_000_000
"""Time before a frame at which pressures change and commands are sent, ns: in the gap before, a
node measures 0.8 ms before its pulse, and the pulses of a turn begin 0.64 ms before that."""
PATIENCE = 6
"""Frame periods for which the last frames are waited for; chosen."""


def script(nodes: int, most: int, seed: int) -> Iterator[Codes]:
    """Yield the codes of so many nodes, frame by frame. most: nodes that may speak in one."""
    rng = np.random.default_rng(seed)
    rest = np.full(nodes, REST_CODE)

    def pressed(which: NDArray[np.int64]) -> Codes:
        codes = rest.copy()
        codes[which] = rng.integers(0, REST_CODE - 10, which.size)
        return codes

    for _ in range(SETTLING):
        yield rest
    for _ in range(RANDOM_FRAMES):
        count = max(1, round(PRESSED_SHARE * nodes))
        yield pressed(rng.choice(nodes, count, replace=False))
    yield rest
    first = rng.integers(nodes - min(HUG, nodes) + 1)
    for _ in range(HUG_FRAMES):
        yield pressed(np.arange(first, first + min(HUG, nodes)))
    yield rest
    everybody = pressed(np.arange(nodes))
    groups = 1 << max(0, math.ceil(math.log2(nodes / (FULL * most))))
    for codes in (everybody, rest):
        for _ in range(WAY + groups):
            yield codes
    for _ in range(4):
        yield pressed(np.arange(0, nodes, 10))


class Rules:
    """Tells what every node says, as docs/protocol.md and firmware/core/event.h have it.

    numbers: of the nodes, from 1, of so many. repeats: by `rest`, else by `change`.
    """

    def __init__(self, numbers: Codes, nodes: int, heartbeat: int, repeats: bool) -> None:
        self._numbers, self._heartbeat, self._repeats = numbers, heartbeat, repeats
        self._beats = (numbers - 1) * heartbeat // nodes
        self._last = np.full(numbers.size, REST_CODE)
        self._owed = np.zeros(numbers.size, bool)

    def speakers(self, frame: int, codes: Codes, turn: int, asked: bool) -> Bools:
        """Tell who speaks in a frame; frames come one after the other. asked: all are, by turns."""
        groups = 2 ** (turn.bit_length() - 1) if turn else 1
        others = self._numbers % groups != turn % groups
        due = self._beats == frame % self._heartbeat
        far = self._repeats & (np.abs(codes - REST_CODE) > THRESHOLD)
        speaks: Bools = far | (np.abs(codes - self._last) > THRESHOLD) | due | self._owed | asked
        speaks &= ~others & (frame >= CLOCK_KNOWN)
        self._owed = (self._owed | (due & others)) & ~speaks
        self._last = np.where(speaks, codes, self._last)
        return speaks


@dataclass
class Found:
    """Counts over all frames after SETTLING.

    speaking: nodes that did, in all frames. wrong: certain words that were not said, or not so.
    missed: words that were said, of nodes that are called silent. unflagged: frames of more words
    than a frame holds that are called certain. doubted: others that are not. in_groups: frames of
    a group. heard: nodes whose word came in a turn. lost, blind: frames that a second driver lost,
    by which the nodes are asked to speak, and most in a row in which it had more doubts. said:
    nodes, from 0, and the codes that they said.
    """

    frames: int = 0
    speaking: int = 0
    most: int = 0
    wrong: int = 0
    missed: int = 0
    unflagged: int = 0
    doubted: int = 0
    in_groups: int = 0
    lost_samples: int = 0
    lost: int = 0
    blind: int = 0
    cpu_load: float = 0.0
    heard: Bools = field(default_factory=lambda: np.zeros(0, bool))
    said: set[tuple[int, int]] = field(default_factory=set)

    @property
    def all_is_well(self) -> bool:
        """Tell whether everybody was heard, and nothing false."""
        false = self.wrong + self.missed + self.unflagged + self.doubted + self.lost_samples
        return bool(self.frames and self.heard.all() and not false)

    def compare(
        self, frame: TactileFrame, wired: Codes, said_codes: Codes, speaks: Bools, most: int
    ) -> None:
        """Count a frame; most: words that a frame holds."""
        words = frame.words
        self.frames += 1
        self.speaking += int(speaks.sum())
        self.most = max(self.most, int(speaks.sum()))
        said = np.zeros(words.active.size, bool)
        said[wired] = speaks
        codes = np.zeros(words.active.size, np.int64)
        codes[wired] = said_codes
        certain = ~words.doubtful
        if speaks.sum() > most:
            self.unflagged += bool(certain.any())
        else:
            self.doubted += bool(words.doubtful.any())
        right = said & (np.abs(words.codes - codes) <= 1)
        self.wrong += int(np.sum(certain & words.active & ~right))
        self.missed += int(np.sum(certain & ~words.active & said))


class Host:
    """Makes frames of the bytes, as the driver does, and takes note of turns."""

    def __init__(self, config: SkinConfig) -> None:
        self.pipeline, self._parser = Pipeline(config), PacketParser()
        self.turns: dict[int, tuple[int, bool]] = {}
        """And whether all whose turn it is are asked, by the time of the frame's first chip, µs."""

    def feed(self, data: bytes, now_ns: int) -> list[TactileFrame]:
        """Return the frames that bytes complete."""
        for packet in self._parser.feed(data):
            if isinstance(packet, Samples | Quiet) and packet.sync:
                self.turns[packet.device_time_us] = packet.turn, packet.asked
        return self.pipeline.feed(data, now_ns * 1e-9)


def on_one_wire(
    values: dict[str, Value],
    images: int | None = None,
    spread: Spread = CRYSTALS,
    record: Path | None = None,
    step_count: int | None = None,
) -> Found:
    """Run a skin of these parameters through the script.

    images: number of nodes that are on the wire, spread over all numbers; None: all. step_count:
    of the script, only so many steps. record: a file to write.
    """
    config = SkinConfig.of(values)
    spec = config.spec
    heartbeat = usual_heartbeat(spec.frame_period_s)
    nodes = reference_nodes(config, spread, mcu=FAST, threshold=THRESHOLD, rest=REST_CODE)
    wired = np.linspace(0, spec.nodes - 1, images or spec.nodes).round().astype(np.int64)
    found, rules = Found(), Rules(wired + 1, spec.nodes, heartbeat, config.nodes_repeat)
    steps = list(script(wired.size, capacity(spec), spread.seed))[:step_count]
    period_ns = round(spec.frame_period_s * 1e9)
    host, session = Host(config), Session(config)
    lossy = LossyDriver(config, session, LOSE_EVERY)
    supplies_v = np.array([nodes[number].supply_v for number in wired])
    recorder = Recorder(record, "emulated RP2040", 0, values) if record is not None else None
    with Rp2040Skin([nodes[number] for number in wired], reference_amplifier(config)) as skin:
        frames: list[TactileFrame] = []

        def run(t_ns: int) -> None:
            skin.run(t_ns)
            data = skin.read()
            if recorder is not None:
                recorder.write(data, skin.now_ns * 1e-9)
            frames.extend(host.feed(data, skin.now_ns))
            if request := lossy.feed(data, skin.now_ns * 1e-9):
                skin.write(request)

        skin.press(REST_CODE / 1024 * supplies_v)
        run(40_000_000)
        skin.write(session.open())
        while not host.turns:
            run(skin.now_ns + period_ns // 4)
        mark_ns = min(host.turns) * 1000
        for number, codes in enumerate(steps):
            run(max(skin.now_ns, mark_ns + number * period_ns - COMMANDED_NS))
            skin.press(codes / 1024 * supplies_v)
            skin.write(session.watch(lossy.pipeline, skin.now_ns * 1e-9))
        run(skin.now_ns + PATIENCE * period_ns)
        found.cpu_load = skin.chip.load
    if recorder is not None:
        recorder.close()
    told = {round((us * 1000 - mark_ns) / period_ns): said for us, said in host.turns.items()}
    decoded = {round((frame.t_start * 1e9 - mark_ns) / period_ns): frame for frame in frames}
    found.heard = np.zeros(wired.size, bool)
    for number, codes in enumerate(steps):
        turn, asked = told[number]
        speaks = rules.speakers(number, codes, turn, asked)
        if number < SETTLING or number not in decoded:
            continue
        found.compare(decoded[number], wired, codes, speaks, capacity(spec))
        found.said |= set(zip(wired[speaks].tolist(), codes[speaks].tolist(), strict=True))
        if turn:
            found.in_groups += 1
            words = decoded[number].words
            found.heard |= (words.active & ~words.doubtful)[wired] & speaks
    found.lost_samples = host.pipeline.counters.lost_samples
    lossy.compare(frames)
    found.lost, found.blind = lossy.lost, lossy.most_blind
    found.wrong += lossy.wrong
    found.unflagged += lossy.unflagged
    return found
