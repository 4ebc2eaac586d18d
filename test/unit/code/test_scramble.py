# SPDX-License-Identifier: Apache-2.0

"""Frames whose chips all nodes flip alike: the sequence, by the document, and what it serves."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.doubt.words import TIMINGS, compare, decode
from tactile_cdma.code.codes import chip_flips, scrambler_state
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import chips_of, rows_of
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import Signs
from tactile_cdma.wire.messages import FrameLayout, Start
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.words import Words
from test.support.chip_line import hear, read_chips
from test.support.independent_line import Line, Skin, Talk, render
from test.support.simulated import Truth, configuration, run, stream
from test.support.single_frames import SingleReader

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
    # of chip means level and noise at rest are learnt: the first eight frames may be in doubt
    assert doubtful <= (8 if samples_per_chip == 1 else 0)
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
            frame = hear(chips, heard)
            if frame is not None and frame.words is not None:
                words = frame.words
                right[scramble] += np.count_nonzero(
                    ~words.doubtful & words.active & (words.codes == codes)
                )
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
    rng, doubted = np.random.default_rng(by + 5), 0
    for _ in range(20):
        codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.5
        late = int(rng.integers(nodes))
        active[late] = True

        def words(by: int) -> Words:
            chips = line_of(spec, codes, active, late, by)  # noqa: B023
            chips = chips + rng.normal(0, 0.1, chips.size)
            return read_chips(chips.astype(np.float32).reshape(-1, order), spec, 0.1)

        found = words(by)
        assert found.doubtful[late]
        others = (np.arange(nodes) != late) & active
        sure = others & ~found.doubtful
        assert found.active[sure].all()
        np.testing.assert_array_equal(found.codes[sure], codes[sure])
        sound = words(0)
        doubted += np.count_nonzero(sound.doubtful)
        np.testing.assert_array_equal(sound.active, active)
    assert doubted <= 0.01 * 20 * nodes


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
        frame = hear(noisy, spec, 0.03)
        if frame is None:
            continue
        words = frame.words
        silent = ~words.active
        assert silent[0] or words.doubtful[0]
        assert words.doubtful[silent].all()


@pytest.mark.parametrize("scene", ["idle", "press"])
def test_silent_frames_of_unknown_amplitude_are_frames(scene: str) -> None:
    url = f"sim://?seed=2&scene={scene}"
    config = SkinConfig.of({"scramble": True, "amplitude_mv": 0.0})
    frames = run(config, stream(SkinConfig.of({"scramble": True}), url, 200))
    assert len(frames) >= 198


@pytest.mark.parametrize("scramble", [False, True])
def test_frames_of_two_nodes_with_one_word_are_no_longer_ties(scramble: bool) -> None:
    """Gap timing, starts anywhere: shifted by a chip such a frame looks like another one."""
    skin = Skin(scramble=scramble)
    talk, line = Talk(together=2, words="equal"), Line(start_jitter_chips=30.0, noise_v=0.03)
    recording = render(skin, talk, line, TIMINGS["gap"], 150, seed=3)
    counts, complaints = compare(recording, decode(recording), line)
    assert not counts.false, complaints
    flagged = counts.flagged + counts.tied
    assert flagged < 0.03 * counts.words if scramble else flagged > 0.1 * counts.words


@pytest.mark.parametrize("samples_per_chip", [1, 4])
def test_a_lone_late_node_is_not_called_silence(samples_per_chip: int) -> None:
    """Its chips are noise that the gap has not: such frames are rejected, or in doubt."""
    spec = FrameSpec(scramble=True, amplitude_v=0.3)
    reader = SingleReader(spec, samples_per_chip / spec.chip_s)
    rng, all_nodes = np.random.default_rng(1), np.ones(16, bool)
    for number in range(60):
        codes = rng.integers(0, 1024, 16)
        chips = {
            0: lambda c: line_chips(spec, c, all_nodes).ravel(),
            1: lambda c: line_of(spec, c, np.arange(16) == 5, 5, 1),
            2: lambda c: np.zeros(spec.chips),
        }[number % 3](codes)
        volts = np.append(np.repeat(chips, samples_per_chip), np.zeros(4 * samples_per_chip))
        if samples_per_chip == 1:
            volts = volts[: spec.chips]
        else:
            reader.learn_rest(0.0, 0.02**2 / samples_per_chip)
        volts += rng.normal(0, 0.02, volts.size)
        frame = reader.read(volts.astype(np.float32))
        if number < 30:  # of means the noise is learnt from frames
            continue
        if number % 3 == 1:
            assert frame is None or (frame.words is not None and frame.words.doubtful.all())
        else:
            assert frame is not None
            spoke = frame.words is not None and frame.words.active.all()
            assert spoke == (number % 3 == 0)
