# SPDX-License-Identifier: Apache-2.0

"""Frames whose chips all nodes flip alike: the sequence, by the document, and what it serves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Bools
from tactile_cdma.code.codes import chip_flips, scrambler_state
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import NodeLevels
from tactile_cdma.code.transform import chips_of, rows_of
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.framing.gaps.gap_timing import GapTiming
from tactile_cdma.framing.line_timing import LineTiming
from tactile_cdma.framing.timing import SampleBlock
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import Signs
from tactile_cdma.wire.messages import FrameLayout, Start
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words import lateness
from tactile_cdma.words.decode import Words, decode
from test.support.correlations import read_chips
from test.support.simulated import Truth, configuration, run, stream

MASK = 0xFFFFFFFF
MOST_LATE = 40
"""Chips."""


def test_no_seed_stops_it() -> None:
    """The state 0 would stay 0, and flip nothing; this seed's hash is 0."""
    seed = -65_536 * 0x9E3779B9 & MASK
    assert scrambler_state(seed) == 1
    assert (chip_flips(10, 20, seed) < 0).any()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("order", [912, 20])
def test_it_is_balanced_and_unlike_itself_shifted(order: int, seed: int) -> None:
    flips = chip_flips(10, order, seed).ravel().astype(float)
    assert abs(flips.mean()) < 4 / np.sqrt(flips.size)
    for shift in range(1, min(200, flips.size // 2)):
        both = flips[shift:] * flips[:-shift]
        assert abs(both.mean()) < 5 / np.sqrt(both.size)


def test_rows_and_chips_are_each_others_inverse() -> None:
    spec = FrameSpec(nodes=19, order=20, first_row=0, scramble=True)
    rows = np.random.default_rng(1).normal(size=(spec.line_bits, 20)).astype(np.float32)
    np.testing.assert_allclose(rows_of(chips_of(rows, spec), spec), rows, atol=1e-6)


def test_the_wire_carries_it() -> None:
    layout = FrameLayout.of(FrameSpec(scramble=True), 4)
    assert layout.signs == Signs.SCRAMBLED
    assert FrameLayout.unpack(layout.pack()).spec(0.3) == FrameSpec(scramble=True)
    assert not FrameLayout.of(FrameSpec(), 4).spec().scramble


@pytest.mark.parametrize("samples_per_chip", [1, 4])
@pytest.mark.parametrize("parity", [False, True])
def test_a_scrambled_skin_is_decoded(samples_per_chip: int, parity: bool) -> None:
    """And not by parameters that the digitizer's description contradicts."""
    values = {"scramble": True, "samples_per_chip": samples_per_chip, "parity": parity}
    config = SkinConfig.of(values)
    url = "sim://?seed=1&scene=all&threshold=0&offset=0.2&noise=0.02"
    data = stream(config, url, 40)
    digitizer = VirtualDigitizer(SimOptions.from_url(url), clock=lambda: 0.0)
    for command in (configuration(config), Start()):
        digitizer.receive(PacketWriter().encode(command))
    frames = run(config, data)
    assert len(frames) >= 38
    seen, truths = set(), Truth(digitizer)
    for frame in frames:
        truth = truths[round(frame.t_start / config.spec.frame_period_s)]
        assert frame.t_start == pytest.approx(truth.start_s, abs=config.spec.chip_s)
        np.testing.assert_array_equal(frame.words.active, truth.active)
        np.testing.assert_array_equal(frame.words.codes, truth.codes)
        seen |= {*truth.codes.tolist()}
    assert len(seen) > 40
    doubtful = sum(f.words.doubtful.any() for f in frames)
    # of chip means the level at rest is a guess: now and then a frame is said to be in doubt
    assert doubtful <= (1 if samples_per_chip == 1 else 0)
    assert not run(SkinConfig.of({**values, "scramble": False}), data)


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
def test_who_does_not_know_of_it_hears_hardly_a_word(nodes: int, order: int) -> None:
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng, right = np.random.default_rng(nodes), {True: 0, False: 0}
    for _ in range(20):
        codes = rng.integers(0, 1024, nodes)
        chips = line_chips(spec, codes).astype(np.float32)
        for scramble in right:
            heard = replace(spec, scramble=scramble)
            words = read_chips(chips, heard)
            right[scramble] += np.count_nonzero(words.active & (words.codes == codes))
    assert right[True] == 20 * nodes
    assert right[False] <= 20 * nodes / 200


def line_of(
    spec: FrameSpec, codes: NDArray[np.int64], active: NDArray[np.bool_], late: int, by: int
) -> NDArray[np.float32]:
    """Chips of these nodes, of which one is late by whole chips; negative: early."""
    own = np.arange(spec.nodes) == late
    chips = line_chips(spec, codes, active & ~own).ravel()
    other = np.pad(line_chips(spec, codes, active & own).ravel(), MOST_LATE)
    return chips + other[MOST_LATE - by : MOST_LATE - by + chips.size]


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
@pytest.mark.parametrize("by", [-2, -1, 1, 2])
def test_nodes_that_are_late_by_chips_are_named_and_disturb_nobody(
    nodes: int, order: int, by: int
) -> None:
    """They show in no row, and so look silent: that must be in doubt, and only that."""
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng = np.random.default_rng(by + 5)
    for _ in range(20):
        codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.5
        late = int(rng.integers(nodes))
        active[late] = True

        def words(by: int) -> Words:
            chips = line_of(spec, codes, active, late, by)  # noqa: B023
            chips = chips + rng.normal(0, 0.1, chips.size)
            return read_chips(chips.astype(np.float32).reshape(-1, order), spec)

        found = words(by)
        assert found.doubtful[late]
        others = (np.arange(nodes) != late) & active
        sure = others & ~found.doubtful
        assert found.active[sure].all()
        if order > 20:  # of so few chips a late one disturbs all
            assert sure.sum() >= others.sum() - 3
        np.testing.assert_array_equal(found.codes[sure], codes[sure])
        sound = words(0)
        assert not sound.doubtful.any()
        np.testing.assert_array_equal(sound.active, active)


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (60, 64), (900, 912)])
@pytest.mark.parametrize("by", [-5, 3, 8, 40, None])
def test_no_node_is_silent_beside_one_that_is_not_understood(
    nodes: int, order: int, by: int | None
) -> None:
    """One that is later than is looked for, or (None) does not flip its chips."""
    spec = FrameSpec(nodes=nodes, order=order, scramble=True, frame_period_s=10.0, amplitude_v=0.3)
    rng = np.random.default_rng(nodes)
    for _ in range(20):
        codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.5
        active[:2], own = True, np.arange(nodes) == 0
        if by is None:
            chips = line_chips(spec, codes, active & ~own)
            chips = chips + line_chips(replace(spec, scramble=False), codes, own)
        else:
            chips = line_of(spec, codes, active, 0, by).reshape(-1, order)
        noisy = (chips + rng.normal(0, 0.03, chips.shape)).astype(np.float32)
        words = read_chips(noisy, spec)
        silent = ~words.active
        assert silent[0] or words.doubtful[0]
        assert words.doubtful[silent].all()


def test_an_unknown_offset_is_no_reason_to_look_for_late_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = FrameSpec(nodes=60, order=64, scramble=True, frame_period_s=40e-3)
    rows = np.zeros((spec.line_bits, spec.order), np.float32)
    signs = np.random.default_rng(3).choice([-1, 1], (spec.line_bits, spec.nodes))
    rows[:, spec.node_slice] = signs
    looks: list[Bools] = []
    look = lateness.displaced

    def note(*arguments: Any) -> tuple[Bools, bool]:
        found, hidden = look(*arguments)
        looks.append(found)
        return found, hidden

    monkeypatch.setattr(lateness, "displaced", note)

    def hear(chips: NDArray[np.float32]) -> None:
        heard = rows_of(chips, spec)
        levels = NodeLevels(heard[:, spec.node_slice], 0.0, rows=heard)
        amplitude = np.abs(levels.values).mean(axis=0)
        lateness.out_of_place(levels, amplitude, amplitude > 0.5, 1.0, spec)

    sent = chips_of(rows, spec)
    hear(sent)
    hear(sent + np.float32(0.5))
    assert not looks
    alone = np.zeros_like(rows)
    alone[:, spec.first_row] = signs[:, 0]
    delayed = np.append(np.zeros(2), chips_of(alone, spec).ravel()[:-2]).reshape(rows.shape)
    hear((chips_of(rows - alone, spec) + delayed).astype(np.float32))
    assert [np.flatnonzero(found).tolist() for found in looks] == [[0]]


@pytest.mark.parametrize("scene", ["idle", "press"])
def test_silent_frames_of_unknown_amplitude_are_frames(scene: str) -> None:
    url = f"sim://?seed=2&scene={scene}"
    config = SkinConfig.of({"scramble": True, "amplitude_mv": 0.0})
    frames = run(config, stream(SkinConfig.of({"scramble": True}), url, 200))
    assert len(frames) >= 198


@pytest.mark.parametrize("scramble", [False, True])
def test_frames_of_two_nodes_with_one_word_are_no_longer_ties(scramble: bool) -> None:
    """Gap timing, starts anywhere: shifted by a chip such a frame looks like another one."""
    spec = FrameSpec(scramble=scramble, amplitude_v=0.3)
    rng, per_chip, frames = np.random.default_rng(3), 8, 150
    period = round(spec.frame_period_s / spec.chip_s * per_chip)
    timing = GapTiming(spec, per_chip / spec.chip_s)
    lines, truth = [], []
    for _ in range(frames):
        active = np.zeros(16, bool)
        active[rng.choice(16, 2, replace=False)] = True
        codes = np.full(16, rng.integers(0, 1024))
        line, begin = np.zeros(period), 200 + int(rng.integers(0, 60))
        line[begin : begin + spec.chips * per_chip] = np.repeat(
            line_chips(spec, codes, active).ravel(), per_chip
        )
        lines.append(line + rng.normal(0, 0.03, period))
        truth.append((codes, active))
    found = timing.feed(SampleBlock(0, np.concatenate(lines).astype(np.float32))) + timing.flush()
    doubtful = 0
    for frame in found:
        assert frame.levels is not None
        words = decode(frame.levels, spec)
        if frame.doubtful is not None:
            words = words.doubted(frame.doubtful)
        codes, active = truth[int(frame.start // period)]
        sure = words.active & ~words.doubtful
        assert not (sure & ((words.codes != codes) | ~active)).any()
        doubtful += bool(words.doubtful.any())
    assert len(found) == frames
    assert doubtful == 0 if scramble else doubtful > frames / 10


@pytest.mark.parametrize("samples_per_chip", [1, 4])
def test_a_lone_late_node_is_not_called_silence(samples_per_chip: int) -> None:
    """Its chips are noise that the gap has not: such frames are rejected, silent ones are not."""
    spec = FrameSpec(scramble=True, amplitude_v=0.3)
    timing = LineTiming(spec, samples_per_chip / spec.chip_s)
    rng, all_nodes = np.random.default_rng(1), np.ones(16, bool)
    gap = 0 if samples_per_chip == 1 else round(2.8e-3 / spec.chip_s) * samples_per_chip
    index, heard = 0, []
    for number in range(30):
        codes = rng.integers(0, 1024, 16)
        chips = {
            0: lambda c: line_chips(spec, c, all_nodes).ravel(),
            1: lambda c: line_of(spec, c, np.arange(16) == 5, 5, 1),
            2: lambda c: np.zeros(spec.chips),
        }[number % 3](codes)
        volts = np.append(np.repeat(chips, samples_per_chip), np.zeros(gap))
        volts += rng.normal(0, 0.02, volts.size)
        block = SampleBlock(index, volts.astype(np.float32), sync=True)
        heard += [(frame, number) for frame in timing.feed(block)]
        index += volts.size
    said = {number: frame.levels is not None for frame, number in heard}
    decided = {kind: [said[n] for n in said if n % 3 == kind] for kind in range(3)}
    assert len(decided[0]) >= 9 and all(decided[0])
    assert not decided[1]
    assert len(decided[2]) >= 9 and not any(decided[2])
