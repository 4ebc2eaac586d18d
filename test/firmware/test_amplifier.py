# SPDX-License-Identifier: Apache-2.0

"""The analog front end: resistors checked by Kirchhoff's laws, estimates by the code book."""

import json
import math
import re
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from amplifier import (
    CIRCUITS,
    CREST,
    DIRECT,
    E12,
    E24,
    E96,
    GROUP_NODES,
    LATE_SAMPLE,
    MOST_GAIN_BANDWIDTH_HZ,
    PAPER,
    RAIL_V,
    SETTLED,
    SIGMAS,
    SUM_OHMS,
    FrontEnd,
    design,
    first_sample_s,
    rest_deviation_v,
    step_left,
)
from design_amplifier import describe, gaussian_clipping, loads, main, resolution
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import code_book, row_signs
from tactile_cdma.code.encode import line_chips, word_bits
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate, spread
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import SCENES
from tolerance import MOST_DRAWN, SKINS, scatter

ROOT = Path(__file__).resolve().parents[2]
README, WIRED_64 = ROOT / "firmware" / "README.md", ROOT / "config" / "wired_64.yaml"
PERIOD_S = 100.0
fronts = st.builds(
    lambda nodes, samples, supply_v, active, circuit: design(
        FrameSpec(nodes=nodes, frame_period_s=PERIOD_S),
        samples,
        supply_v=supply_v,
        active=active,
        circuit=circuit,
    ),
    st.one_of(st.integers(1, 40), st.integers(41, 1000)),
    st.integers(1, 8),
    st.floats(2.7, 5.0),
    st.floats(0.05, 1.0),
    st.sampled_from(CIRCUITS),
)


def skin(nodes: int, circuit: str = DIRECT, **changes: object) -> tuple[FrameSpec, FrontEnd]:
    spec = FrameSpec(**{"nodes": nodes, "frame_period_s": PERIOD_S, **changes})
    return spec, design(spec, 4, circuit=circuit)


def network(front: FrontEnd, pins: NDArray[np.int_], open_loop: float = 1e12) -> float:
    """The amplifier's output, V, of pins that are high (1), low (−1) or released (0).

    Kirchhoff's current law at every junction of resistors, solved as one system: the junctions of
    the nodes, the line, and the output. Pins and followers are ideal; the amplifier has an
    open-loop gain.
    """
    n = len(pins)
    line, output = n, n + 1
    matrix, currents = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
    stage = front.nodes_stage
    for node, pin in enumerate(pins):
        pin_v = front.supply_v if pin > 0 else 0.0
        if front.attenuator is None:  # a source, or at the line's voltage
            matrix[node, node], currents[node] = 1, pin_v
            if not pin:
                matrix[node, line] = -1
        else:
            bias_ohm = front.attenuator.bias_ohm
            sources = [(bias_ohm, front.supply_v), (bias_ohm, 0.0)]
            if pin:
                sources.append((front.attenuator.series_ohm, pin_v))
            for ohm, volts in sources:
                matrix[node, node] += 1 / ohm
                currents[node] += volts / ohm
        matrix[line, line] += 1 / stage.input_ohm
        matrix[line, node] -= 1 / stage.input_ohm
    matrix[line, line] += 1 / stage.feedback_ohm
    matrix[line, output] -= 1 / stage.feedback_ohm
    matrix[output, [output, line]] = 1 / open_loop, 1  # output = gain · (+ input − line)
    currents[output] = front.supply_v / 2
    return float(np.linalg.solve(matrix, currents)[output])


@given(fronts, st.data())
def test_the_output_is_rest_minus_a_times_the_sum_of_the_pins(
    front: FrontEnd, data: st.DataObject
) -> None:
    pins = np.array(data.draw(st.lists(st.sampled_from([-1, 0, 1]), min_size=1, max_size=20)))
    each_v = front.node_level_v * front.nodes_stage.gain
    expected = front.supply_v / 2 - each_v * pins.sum()
    assert network(front, pins) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_the_noise_gain_divides_the_open_loop_gain(circuit: str) -> None:
    _, front = skin(40, circuit)
    pins = np.ones(40, int)
    ideal, real = (network(front, pins, gain) - network(front, -pins, gain) for gain in (1e12, 1e4))
    assert ideal / real - 1 == pytest.approx(front.nodes_stage.noise_gain / 1e4, rel=1e-3)


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("nodes", [1, 16, 64, 900])
@pytest.mark.parametrize("wire", [0.0, 1.0])
def test_the_gain_bandwidth_suffices_with_wire_on_the_line(
    nodes: int, wire: float, circuit: str
) -> None:
    """At the corner of the feedback, where the amplifier's gain is GBW/f and lags by 90°.

    wire: capacitance of the line over what firmware/README.md allows.
    """
    front = skin(nodes, circuit)[1].nodes_stage
    f = front.corner_hz
    feedback = 1 / (1 / front.feedback_ohm + 2j * math.pi * f * front.feedback_f)
    wire_f = wire * max((front.noise_gain - 1) * front.feedback_f, front.wire_f)
    noise_gain = 1 + feedback * (front.inputs / front.input_ohm + 2j * math.pi * f * wire_f)
    actual_over_ideal = 1 / (1 + noise_gain * 1j * f / front.gain_bandwidth_hz)
    assert abs(actual_over_ideal - 1) <= 0.1
    if wire:
        assert abs(actual_over_ideal - 1) > 0.05  # and it is not asked for more than is needed


def is_of(series: tuple[int, ...], value: float) -> bool:
    mantissa = value / 10.0 ** (math.floor(math.log10(value * (1 + 1e-9)) - math.log10(series[0])))
    return min(abs(mantissa - part) for part in series) < 1e-6


@given(fronts)
def test_parts_are_those_that_one_can_buy(front: FrontEnd) -> None:
    paper = front.attenuator
    for ohm in (front.filter_ohm, *((paper.series_ohm, paper.bias_ohm) if paper else ())):
        assert is_of(E24, ohm)
    for stage in front.stages:
        inputs = E96 if stage is front.nodes_stage and not paper else E24
        assert is_of(inputs, stage.input_ohm) and is_of(E24, stage.feedback_ohm)
        assert is_of(E12, stage.feedback_f)
        assert stage.feedback_ohm >= 2e3 and stage.input_ohm >= 2e3
        assert stage.gain_bandwidth_hz <= MOST_GAIN_BANDWIDTH_HZ
    assert is_of((10,), front.filter_f)
    assert 250 < front.filter_ohm <= 3000


@given(fronts)
def test_the_range_is_used_and_not_exceeded(front: FrontEnd) -> None:
    needed = min(front.talking, CREST * math.sqrt(front.talking))
    assert needed <= front.room * (1 + 1e-9)
    assert front.room < 1.2 * needed  # neighbours in E24 are up to 10 % apart, Rf and Rin
    assert front.room_v <= min(front.supply_v / 2, 3.3 - front.supply_v / 2)
    level_v = 0.3 if front.attenuator else front.supply_v / 2
    assert front.node_level_v == pytest.approx(level_v, rel=0.03)


def test_what_low_passes_leave_of_a_step() -> None:
    """One and two poles in closed form; n of them by the steps of an integration."""
    assert step_left(2.0, [1.0]) == pytest.approx(math.exp(-2), rel=1e-3)
    assert step_left(6.638, [1.0, 1.0]) == pytest.approx((1 + 6.638) * math.exp(-6.638), rel=0.02)
    poles_s, step_s = [0.1, 0.1, 0.1, 0.01, 0.03], 1e-5
    values = np.zeros(len(poles_s))
    for _ in range(round(0.7 / step_s)):
        values += step_s / np.array(poles_s) * (np.append(1.0, values[:-1]) - values)
    assert step_left(0.7, poles_s) == pytest.approx(1 - values[-1], rel=0.02)


def test_when_a_chip_is_first_sampled() -> None:
    """In the middle of its first period; where there is one only, as late as by the firmware."""
    assert first_sample_s(50e-6, 4) == 6.25e-6
    assert first_sample_s(50e-6, 16) == pytest.approx(50e-6 / 32)
    assert first_sample_s(50e-6, 1) == 6.25e-6  # a mean is of 4 samples or more
    assert first_sample_s(8e-6, 1) == 1e-6
    assert first_sample_s(7e-6, 4) == LATE_SAMPLE * 7e-6  # the converter could take 3
    assert first_sample_s(2e-6, 4) == LATE_SAMPLE * 2e-6
    assert first_sample_s(2e-6, 4, adc_hz=2e6) == 0.25e-6
    setup = (README.parent / "core" / "setup.c").read_text()
    assert "samples_are_chips ? ticks * 3u / 8u" in setup and LATE_SAMPLE == 0.5 + 3 / 8


@pytest.mark.parametrize("nodes", [2, 16, 64, 200, 900])
@pytest.mark.parametrize("chip_s", [2e-6, 4e-6, 20e-6, 50e-6, 1e-3])
@pytest.mark.parametrize("circuit", CIRCUITS)
def test_steps_have_settled_when_the_first_sample_is_taken(
    nodes: int, chip_s: float, circuit: str
) -> None:
    _, front = skin(nodes, circuit, chip_s=chip_s)
    assert SETTLED / 20 < front.unsettled <= SETTLED


def test_nodes_are_grouped_where_one_amplifier_is_too_slow() -> None:
    _, slow = skin(900)
    assert slow.groups == 1 and slow.polarity == -1
    _, fast = skin(900, chip_s=2e-6)
    assert fast.groups > 1 and fast.polarity == 1
    assert fast.groups * fast.nodes_stage.inputs >= 900
    assert fast.nodes_stage.inputs <= GROUP_NODES
    assert (fast.groups - 1) * fast.nodes_stage.inputs < 900
    gains = [stage.gain for stage in fast.stages]
    assert fast.amplitude_v == pytest.approx(fast.node_level_v * gains[0] * gains[1])
    # the sum of a group does not leave the range either
    group_peak = CREST * math.sqrt(fast.nodes_stage.inputs) * fast.node_level_v * gains[0]
    assert group_peak <= fast.room_v * (1 + 1e-9)
    with pytest.raises(SpecError, match="groups of few nodes need amplifiers of more than 80 MHz"):
        design(FrameSpec(nodes=900, chip_s=0.5e-6, frame_period_s=PERIOD_S), 1, circuit=PAPER)
    short = FrameSpec(nodes=9, chip_s=0.1e-6, frame_period_s=PERIOD_S)
    with pytest.raises(SpecError, match="followers' inputs, with 39 ns, don't settle"):
        design(short, 1, circuit=PAPER)
    with pytest.raises(SpecError, match="use longer chips"):
        design(short, 1)


def test_where_amplifiers_are_too_slow_for_the_whole_range_a_part_is_used() -> None:
    """Few of many nodes at once get no less than all of them, until the parts are too slow."""
    for nodes, active in ((16, 0.01), (64, 0.1), (900, 0.001)):
        spec, every = skin(nodes, chip_s=2e-6)
        front = design(spec, 4, active=active)
        assert front.amplitude_v > every.amplitude_v
        assert all(each.gain_bandwidth_hz <= MOST_GAIN_BANDWIDTH_HZ for each in front.stages)
    assert front.room > 5 * front.talking  # of the last one, with 900 nodes
    assert max(each.gain_bandwidth_hz for each in front.stages) > 0.8 * MOST_GAIN_BANDWIDTH_HZ
    _, lower = skin(16, chip_s=0.5e-6)
    assert 16 < lower.room < 17 and lower.nodes_stage.feedback_ohm == SUM_OHMS[-1]
    with pytest.raises(SpecError, match="use longer chips"):
        skin(64, chip_s=0.5e-6)


@pytest.mark.parametrize(("nodes", "chip_s"), [(16, 50e-6), (64, 50e-6), (900, 2e-6)])
def test_inexact_parts_stay_within_what_was_allowed_for(nodes: int, chip_s: float) -> None:
    """Skins drawn at random, against the deviation by hand.

    Of half the supply, 1 % does; with the paper's circuit it would leave a third of the skins
    outside the range.
    """
    (_, front), (_, paper) = (skin(nodes, circuit, chip_s=chip_s) for circuit in (DIRECT, PAPER))
    drawn, papers = scatter(front), scatter(paper)
    assert drawn.skins == SKINS
    for one, its in ((front, drawn), (paper, papers)):
        expected_v = rest_deviation_v(one.stages, 3.3, one.attenuator)
        assert its.rest_v == pytest.approx(expected_v, rel=0.1)
        assert its.left < 0.01
    assert 0.015 < drawn.level < 0.04 and 0.02 < papers.level < 0.06
    margin_v = 3.3 / 2 - RAIL_V - front.room_v
    assert margin_v == pytest.approx(SIGMAS * drawn.rest_v, rel=0.1)
    assert scatter(front, half_tolerance=0.05).left > 0.1
    coarse = scatter(paper, half_tolerance=0.01)
    assert coarse.rest_v > 4 * papers.rest_v and coarse.left > 0.3
    fastest_hz = [max(stage.gain_bandwidth_hz for stage in one.stages) for one in (front, paper)]
    assert fastest_hz[0] < 0.6 * fastest_hz[1]
    assert front.amplitude_v > 0.95 * paper.amplitude_v


def test_the_share_of_skins_is_that_of_exact_sums() -> None:
    """A front end without room, and one with more than enough; of large skins fewer are drawn."""
    front = skin(16)[1]
    for factor, left in ((1.2, 1.0), (0.8, 0.0)):
        ohm = factor * front.nodes_stage.feedback_ohm
        changed = replace(front, nodes_stage=replace(front.nodes_stage, feedback_ohm=ohm))
        assert scatter(changed).left == left
    assert scatter(skin(4000)[1]).skins == MOST_DRAWN // 4000 < SKINS


def test_the_simulated_clipping_is_that_of_the_code_book() -> None:
    """Against rows and signs written out, drawn anew; and against the Gaussian tail."""
    spec, front = skin(250, order=256)
    tight = replace(front, room_v=2.0 * math.sqrt(250) * front.amplitude_v)
    rng = np.random.default_rng(5)
    rows = spec.node_rows * spec.signs[:, None]
    line = rng.choice([-1, 1], (3000, 250)) @ rows.astype(float)
    drawn = float(np.mean(np.abs(line) > tight.room))
    found = loads(spec, tight)
    assert found["random codes"].clipped == pytest.approx(drawn, rel=0.03)
    assert gaussian_clipping(tight) == pytest.approx(math.erfc(math.sqrt(2)), rel=1e-9)
    assert found["random codes"].clipped == pytest.approx(gaussian_clipping(tight), rel=0.1)
    # All nodes with one code: the same levels in every bit, but for the sign.
    alike = np.abs(rows.sum(axis=0))
    assert found["idle"].peak == alike.max()
    assert found["idle"].clipped == pytest.approx(np.mean(alike > tight.room))


@pytest.mark.parametrize("nodes", [1, 16, 64, 255, 1023])
def test_the_designed_range_is_hardly_ever_left(nodes: int) -> None:
    spec, front = skin(nodes)
    for load in loads(spec, front).values():
        assert load.clipped == 0
        assert load.peak <= min(nodes, front.room)
    assert gaussian_clipping(front) < 1e-7
    if nodes <= CREST**2:
        assert gaussian_clipping(front) == 0  # no sum of so few leaves the range


def test_natural_signs_and_few_talkers() -> None:
    spec, natural = skin(63, order=64, sign_seed=None)
    assert natural.room == pytest.approx(63, rel=0.05)
    assert loads(spec, natural)["idle"].peak == 63
    few = design(spec, 4, active=0.1)
    assert few.talking == 7
    assert max(load.peak for load in loads(spec, few).values()) <= 7 <= few.room


@pytest.mark.parametrize("adc_bits", [6, 8, 12])
def test_rho_is_what_quantised_words_show(adc_bits: int) -> None:
    spec, front = skin(60, order=64)
    front = replace(front, adc_bits=adc_bits)
    rng = np.random.default_rng(adc_bits)
    symbols = np.zeros((2000, 64), np.float32)
    symbols[:, spec.rows] = rng.choice([-1, 1], (2000, 60)) * spec.signs
    volts = symbols @ spec.book.matrix.astype(np.float32) * front.amplitude_v
    count_v = front.adc_volts / 2**adc_bits
    volts += rng.uniform(-count_v, count_v, (2000, 1))  # the rest level is anywhere
    errors = correlate((np.rint(volts / count_v) * count_v - volts).astype(np.float32), spec.book)
    measured = front.amplitude_v / errors[:, spec.rows].std()
    assert resolution(spec, front).rho == pytest.approx(measured, rel=0.05)
    assert resolution(spec, front).count == pytest.approx(count_v / front.amplitude_v)


def test_wrong_words_follow_from_rho() -> None:
    spec, front = skin(64)
    assert resolution(spec, front).wrong_words < 1e-300
    coarse = resolution(spec, replace(front, adc_volts=1000.0))
    wrong_bit = 0.5 * math.erfc(coarse.rho / math.sqrt(2))
    assert 1e-5 < wrong_bit < 1e-1
    assert coarse.wrong_words == pytest.approx(1 - (1 - wrong_bit) ** spec.line_bits)


def symbols_of_scenes(order: int, frames: int) -> list[NDArray[np.float32]]:
    """Symbols ±1 of some frames of every scene of the simulator, 0.37 s apart, (k, N) each."""
    spec = FrameSpec(nodes=order - 1, order=order, chip_s=1e-6, frame_period_s=0.37)
    symbols = []
    for scene in SCENES:
        for said in islice(truth(SimOptions(scene=scene, threshold=0), Setup(spec)), frames):
            bits = np.zeros((spec.bits, order), dtype=np.float32)
            bits[:, spec.rows] = 2.0 * word_bits(said.codes, spec.bits).T - 1.0
            symbols.append(bits)
    return symbols


@pytest.mark.parametrize("order", [256, 1024, 4096])
def test_random_signs_keep_all_scenes_below_the_crest_factor(order: int) -> None:
    highest = 0.0
    for seed in range(1, 11):
        signs = row_signs(np.arange(order), seed)
        for symbols in symbols_of_scenes(order, 4):
            line = spread(symbols * signs, code_book(order))
            highest = max(highest, float(np.abs(line).max() / np.sqrt(np.square(line).mean())))
    assert 4 < highest < CREST


@pytest.mark.parametrize("sign_seed", [1, None], ids=["random", "natural"])
@pytest.mark.parametrize("order", [256, 1024, 4096])
def test_sensible_bits_are_those_that_suffice(order: int, sign_seed: int | None) -> None:
    """The fewest with at most 1.1 times the errors (0.09 dB) of an exact converter at ρ = 3.

    At the best of several full scales; one fixed beforehand costs up to a bit more, or is as good.
    """
    rng, book = np.random.default_rng(order), code_book(order)
    signs, sent = row_signs(np.arange(order), sign_seed), symbols_of_scenes(order, 4096 // order)
    noise_rms = math.sqrt(order) / 3
    lines = [
        spread(symbols * signs, book) + rng.normal(0, noise_rms, symbols.shape) for symbols in sent
    ]

    def wrong(full: float = 1.0, bits: int = 0) -> int:
        total = 0
        for symbols, line in zip(sent, lines, strict=True):
            step, half = 2 * full / 2**bits, 2 ** (bits - 1)
            seen = np.clip(np.rint(line / step), -half, half - 1) * step if bits else line
            found = correlate(seen.astype(np.float32), book) * signs
            total += int(((found > 0) != (symbols > 0))[:, 1:].sum())
        return total

    scales = np.sqrt(order - 1) * np.array([2, 2.5, 3, 4, 5, 6, math.sqrt(order - 1)])
    enough = 1.1 * wrong()
    fewest = next(b for b in range(3, 14) if min(wrong(c, b) for c in scales) <= enough)
    spec, front = skin(order - 1, order=order, sign_seed=sign_seed)
    assert abs(resolution(spec, front).sensible_bits - fewest) <= 1


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({}, {"supply_v": 12.0}, "supply_v is 12; it must lie within 1.8…5.5"),
        ({}, {"supply_v": math.nan}, "supply_v is nan"),
        ({}, {"adc_volts": math.nan}, "adc_volts is nan"),
        ({}, {"adc_volts": 1.1}, "adc_volts is 1.1 V, but the line rests at 1.65 V"),
        ({}, {"adc_bits": 3}, "adc_bits is 3; it must lie within 4…24"),
        ({}, {"active": 0.0}, "active is 0; it must lie within 1e-06…1: it is a share"),
        ({"drive": "unipolar"}, {}, "drive is 'unipolar', but nodes that rest at mid-supply"),
    ],
)
def test_bad_input_is_named(changes: dict, options: dict, message: str) -> None:
    with pytest.raises(SpecError) as error:
        design(FrameSpec(**changes), 4, **options)
    assert message in str(error.value)


def test_a_lower_reference_costs_range() -> None:
    front = design(FrameSpec(), 4, adc_volts=3.0)
    assert front.room_v == pytest.approx(3.0 - 1.65, rel=0.03)
    assert design(FrameSpec(), 4).room_v == pytest.approx(1.65 - RAIL_V, rel=0.03)


def test_the_command_prints_parts_and_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text("skin:\n  ros__parameters: {nodes: 64, frame_period_ms: 40.0}\n")
    assert main(["--params", str(params), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    _, front = skin(64)
    assert found["parts"]["nodes_stage"]["feedback_ohm"] == front.nodes_stage.feedback_ohm
    assert found["parts"]["groups_stage"] is None
    assert found["parts"]["gain"] == front.gain
    assert found["scatter"]["left"] < 0.01
    assert found["loads"]["random codes"]["clipped"] == 0
    spec = SkinConfig.of({"nodes": 64, "frame_period_ms": 40.0, **found["parameters"]}).spec
    assert spec.polarity == -1
    assert spec.amplitude_v == pytest.approx(front.amplitude_v, rel=1e-3)

    assert main(["--nodes", "64"]) == 0
    text = capsys.readouterr().out
    assert "Rin 95.3 kΩ from the pin to the line" in text and "Rf 2 kΩ" in text
    [stated_mv] = re.findall(r"amplitude_mv: ([\d.]+)", WIRED_64.read_text())
    assert f"polarity: -1\namplitude_mv: {stated_mv}\nframe_period_ms: 35\n" in text

    assert main(["--nodes", "64", "--circuit", "paper"]) == 0
    text = capsys.readouterr().out
    assert "Rb 12 kΩ to supply and 12 kΩ to ground" in text
    assert "Rin 33 kΩ" in text and "Rf 3.9 kΩ" in text

    assert main(["--nodes", "64", "--adc-volts", "1.1"]) == 1
    assert "use a lower supply_v" in capsys.readouterr().err


@pytest.mark.parametrize("nodes", [16, 64])
def test_the_values_in_the_document_are_those_of_the_command(nodes: int) -> None:
    spec, front = skin(nodes)
    rows = [line for line in README.read_text().splitlines() if line.startswith(f"| {nodes} |")]
    (row,) = [line for line in rows if "kΩ" in line]
    text = describe(spec, front)
    for cell in row.strip("| ").split(" | ")[1:]:
        for value in cell.split(", "):
            assert value in text, value
    stage = front.nodes_stage
    for ohm in (stage.input_ohm, stage.feedback_ohm):
        assert f"| {ohm / 1e3:g} kΩ |" in row


WIDE_COUNTS = 8.9
"""Of 4 of the RP2040's codes; of others a little less than 1 (RP2040-E11; pico-adc.markomo.me)."""


def converted(counts: NDArray[np.float64]) -> NDArray[np.int_]:
    """Codes for voltages in ideal counts."""
    widths = np.full(4096, (4096 - 4 * WIDE_COUNTS) / 4092)
    widths[[512, 1536, 2560, 3584]] = WIDE_COUNTS
    return np.clip(np.searchsorted(np.cumsum(widths), counts, side="right"), 0, 4095)


@pytest.mark.parametrize("skin", ["breadboard", "wired_skin", "wired_64", "thousand_skin"])
def test_the_weakest_bit_keeps_its_level(skin: str) -> None:
    """Behind the RP2040's converter, whose codes 512, 1536, 2560 and 3584 are wide."""
    spec = SkinConfig.of(read_file(ROOT / "config" / f"{skin}.yaml")).spec
    assert spec.amplitude_v is not None and spec.flips is not None
    rng, amplitude = np.random.default_rng(1), spec.amplitude_v / 3.3 * 4096
    for _ in range(5):
        codes = rng.integers(0, 1024, spec.nodes)
        line = line_chips(spec, codes, np.ones(spec.nodes, bool), amplitude_v=1.0)
        read, gap = (
            converted(2048 + amplitude * volts + rng.standard_normal(line.shape)) / amplitude
            for volts in (line, 0 * line)
        )
        chips = (read - gap.mean()) * spec.flips
        levels = chips @ spec.node_rows.T.astype(np.float32) / spec.order
        assert np.abs(levels).min() > 0.94
