# SPDX-License-Identifier: Apache-2.0

"""The analog chain in SPICE: lumping is exact, and what was computed is what the circuit does."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amplifier import CIRCUITS, DIRECT, PAPER, SETTLED, design
from benchmarks.paper.waves import row_levels_v
from circuit import level_points, netlist
from decoding import wrong_words
from ngspice import noise_v, transient, waveform
from passive_spice import passive_run
from pulse_spice import LEAD_S, Network, Skin, frame, networks, see
from spice import simulate
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.hardware.passive import PIN_F, PassiveLine, check_pulled
from test.support.firmware import needs_ngspice

pytestmark = needs_ngspice
CHIP_S = 50e-6
BOLTZMANN_T = 1.380649e-23 * 300.15


@pytest.mark.parametrize(
    ("nodes", "circuit"), [*((nodes, DIRECT) for nodes in (16, 64, 900)), (16, PAPER)]
)
def test_the_circuit_does_what_was_computed(nodes: int, circuit: str) -> None:
    """And every word of a frame through it is decoded right."""
    config, front, found = simulate(nodes, circuit=circuit)
    assert found.amplitude_v == pytest.approx(front.amplitude_v, rel=0.005)
    assert found.unsettled == pytest.approx(front.unsettled, abs=0.003)
    assert found.unsettled <= SETTLED
    assert found.overshoot < 0.01
    assert found.headroom_v > 0
    assert found.noise_v < 0.1 * front.amplitude_v
    assert (found.words, found.wrong) == (3 * nodes, 0)
    assert config.spec.polarity == front.polarity


def test_without_an_amplifier_every_speaker_adds_as_much() -> None:
    """The less the more speak: of four, two that drive the line are heard alike, as computed."""
    run = passive_run(4, 22e3, 2.2e3, 2)
    assert run.amplitude_v == pytest.approx([run.line.amplitude_v(2)] * 2, rel=0.003)


def test_a_circuit_that_is_too_slow_is_seen() -> None:
    """Ten times the capacitance in the feedback: a step of all nodes has not settled."""
    front = design(FrameSpec(nodes=16, frame_period_s=1.0), 4)
    stage = replace(front.nodes_stage, feedback_f=10 * front.nodes_stage.feedback_f)
    step = np.repeat([-1.0, 1.0, 1.0], 4)[None]
    for circuit, settles in ((front, True), (replace(front, nodes_stage=stage), False)):
        times, volts = waveform(circuit, step, CHIP_S, 12 * CHIP_S)
        early, late = np.interp([4 * CHIP_S + front.sample_s, 8 * CHIP_S], times, volts)
        before = np.interp(4 * CHIP_S, times, volts)
        assert (abs(early - late) < 0.02 * abs(late - before)) == settles


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_lumped_nodes_are_as_many_by_themselves(circuit: str) -> None:
    """Where followers are fast enough not to slew: then the circuit is linear."""
    front = design(FrameSpec(nodes=4, frame_period_s=1.0), 4, circuit=circuit)
    rng = np.random.default_rng(1)
    levels = rng.choice([-1.0, 0.0, 1.0], (4, 30))
    linear = _Fast(**{name: getattr(front, name) for name in front.__dataclass_fields__})
    each = waveform(linear, levels, CHIP_S, 32 * CHIP_S)
    before, after = (np.pad(levels, ((0, 0), side)) for side in ((1, 0), (0, 1)))
    released = np.where(after == 0, before, 0.0).mean(axis=0)
    mean = waveform(linear, levels.mean(axis=0)[None], CHIP_S, 32 * CHIP_S, released)
    begins = CHIP_S * np.arange(32)[:, None]  # steps of the analysis are too long for the edges
    instants = begins + np.linspace(front.sample_s, 0.99 * CHIP_S, 40)
    apart = np.interp(instants, *each) - np.interp(instants, *mean)
    assert np.abs(apart).max() < 1e-3 * front.amplitude_v


class _Fast(type(design(FrameSpec(nodes=4, frame_period_s=1.0), 4))):  # type: ignore[misc]
    """A front end whose followers don't slew."""

    @property
    def follower_slew_v_per_s(self) -> float:
        return 1e9


@pytest.mark.parametrize("speakers", [1, 15])
def test_speakers_have_their_level_on_their_rows_and_leave_some_on_others(speakers: int) -> None:
    """As docs/paper.md has it: with one speaker less than with fifteen, and no word with either."""
    spec = FrameSpec(order=16, first_row=0, sign_seed=None)
    front = design(spec, 4)
    active, codes = np.arange(16) >= 16 - speakers, np.arange(16) * 61
    rows_v = row_levels_v(front, spec, codes, active)
    assert rows_v[:, active].mean() == pytest.approx(front.amplitude_v, rel=0.06)  # edges
    left = rows_v[:, ~active].max() / front.amplitude_v
    assert 0.001 < left < (0.05 if speakers == 1 else 0.25)


def test_a_released_pin_keeps_its_charge_for_a_while(tmp_path: Path) -> None:
    """As its capacitance does, in SPICE, behind a switch that opens: in the gap only."""
    front = design(FrameSpec(nodes=64, frame_period_s=1.0), 4)
    file, end_s = tmp_path / "levels.txt", 3 * CHIP_S
    np.savetxt(file, level_points(np.array([-0.5, 0.5]), CHIP_S), fmt="%.17g")
    text = netlist(front, [str(file)], end_s, 20e-9)
    released = re.sub(
        r"^bpin0 pin0 (.*)$",
        r"bpin0 high \1\nvopen open 0 pulse(1 0 100u 1n 1n 1 2)\nsopen high pin0 open 0 drive\n"
        rf".model drive sw(vt=0.5 ron=0.01 roff=1e12)\ncpin pin0 0 {64 * PIN_F:g}",
        text,
        flags=re.MULTILINE,
    )
    expected = transient(released)
    found = waveform(front, np.array([[-0.5, 0.5]]), CHIP_S, end_s)
    instants = 2 * CHIP_S + np.arange(0.0, 12e-6, 0.1e-6)
    rest_v = front.supply_v / 2
    seen, wanted = (np.interp(instants, *each) - rest_v for each in (found, expected))
    peak_v = 0.5 * 64 * front.amplitude_v
    assert np.abs(seen - wanted).max() < 0.04 * peak_v  # 64 pins leave through the guard, too
    late = np.interp(2 * CHIP_S + front.sample_s, *found) - rest_v
    assert 0.005 * peak_v < abs(late) < 0.05 * peak_v
    paper = design(FrameSpec(nodes=64, frame_period_s=1.0), 4, circuit=PAPER)
    assert paper.tail_s == 0 < front.tail_s


def worst(nodes: int) -> Skin:
    """Parts at their limits: all Rin small, the supply low, and thresholds at 1.25 V."""
    return Skin(np.full(nodes, 0.99), 1.0, (1.0, 1.0), 1.0, 0.95, np.full(nodes, 1.25))


@pytest.mark.parametrize("nodes", [4, 64])
@pytest.mark.parametrize("passive", [False, True])
def test_a_pulled_line_is_at_rest_when_the_calculators_say(nodes: int, passive: bool) -> None:
    """On the longest wire; and every node takes the pulse for what the digitizer made of it."""
    (network, wire_f), *_ = [
        one
        for one in reversed([*networks()])
        if (isinstance(one[0].circuit, PassiveLine), one[0].config.spec.nodes)
        == (passive, min(nodes, 16) if passive else nodes)
    ]
    assert wire_f == 4e-9
    seen = see(network, worst(network.config.spec.nodes), wire_f)
    assert seen.recovery_s <= network.recovery_s(wire_f) < 1.6 * seen.recovery_s
    assert (seen.units == 2).all() and seen.margin_v > 0
    assert 0 < seen.edges_s.max() < 1.5e-6


def test_a_dip_of_a_slow_amplifier_and_of_low_resistors_would_be_a_pulse() -> None:
    """What the calculators add, or refuse, is needed: without it the margin is gone."""
    network, wire_f = next(networks())
    assert see(network, worst(4), wire_f).margin_v > 0
    front = network.circuit
    slow = replace(front, nodes_stage=replace(front.nodes_stage, speed=1.0))
    assert see(replace(network, circuit=slow), worst(4), wire_f).margin_v < 0
    line = PassiveLine(4, 22e3)
    lowest = replace(worst(4), supply=0.91, halves=(1.01, 0.99), threshold_v=np.full(4, 1.24))
    low = Network(network.config, line, 22e3, 1.0)
    assert see(low, lowest, 0.34e-9).margin_v < 0
    with pytest.raises(SpecError, match=r"22000 Ω that are low take the line to 1\.24 V at 3\.0 V"):
        check_pulled(line, 0.34e-9)


def test_words_are_right_though_a_pulse_came_before_them() -> None:
    network, wire_f = next(networks())
    skin, spec = worst(network.config.spec.nodes), network.config.spec
    codes = np.random.default_rng(3).integers(0, 1024, spec.nodes)
    edges_s = see(network, skin, wire_f).edges_s
    times, volts = frame(network, skin, wire_f, edges_s, codes)
    assert wrong_words(network.config, network, times, volts, codes, LEAD_S) == 0


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_noise_is_that_of_its_sources(circuit: str) -> None:
    """Against sums by hand: amplifier and divider times noise gain, resistors, followers."""
    front = design(FrameSpec(nodes=16, frame_period_s=1.0), 4, circuit=circuit)
    stage, paper = front.nodes_stage, front.attenuator
    half_ohm, opamp_ohm = 5e3, 3.9e3
    white = (half_ohm + opamp_ohm) * stage.noise_gain**2
    white += stage.feedback_ohm + 16 * stage.input_ohm * stage.gain**2
    if paper is not None:
        node_ohm = 1 / (1 / paper.series_ohm + 2 / paper.bias_ohm)
        white += 16 * (node_ohm + opamp_ohm) * stage.gain**2
    band_hz = np.pi / 2 * 0.5 * stage.corner_hz  # two equal poles have half of one's band
    expected = np.sqrt(4 * BOLTZMANN_T * white * band_hz)
    assert noise_v(front) == pytest.approx(expected, rel=0.15)


def test_of_sparse_nodes_as_many_talk_as_a_frame_holds() -> None:
    """So each may be louder than where all do."""
    sparse = design(
        FrameSpec(nodes=128, codes="sparse", order=48, scramble=True, frame_period_s=1.0), 4
    )
    assert sparse.talking == 22
    everybody = design(FrameSpec(nodes=128, frame_period_s=1.0), 4)
    assert everybody.talking == 128
    assert sparse.amplitude_v > 1.5 * everybody.amplitude_v
