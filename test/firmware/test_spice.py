# SPDX-License-Identifier: Apache-2.0

"""The analog chain in SPICE: lumping is exact, and what was computed is what the circuit does."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from amplifier import LATE_SAMPLE, SETTLED, design
from ngspice import noise_v, waveform
from passive_spice import passive_run
from spice import simulate
from tactile_cdma.code.frame import FrameSpec

pytestmark = pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="no ngspice on this machine: apt install ngspice"
)
CHIP_S = 50e-6
BOLTZMANN_T = 1.380649e-23 * 300.15


@pytest.mark.parametrize("nodes", [16, 64, 900])
def test_the_circuit_does_what_was_computed(nodes: int) -> None:
    """And every word of a frame through it is decoded right."""
    config, front, found = simulate(nodes)
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


def test_lumped_nodes_are_as_many_by_themselves() -> None:
    """Where followers are fast enough not to slew: then the circuit is linear."""
    front = design(FrameSpec(nodes=4, frame_period_s=1.0), 4)
    rng = np.random.default_rng(1)
    levels = rng.choice([-1.0, 0.0, 1.0], (4, 30))
    linear = _Fast(**{name: getattr(front, name) for name in front.__dataclass_fields__})
    each = waveform(linear, levels, CHIP_S, 32 * CHIP_S)
    mean = waveform(linear, levels.mean(axis=0)[None], CHIP_S, 32 * CHIP_S)
    begins = CHIP_S * np.arange(32)[:, None]  # steps of the analysis are too long for the edges
    instants = begins + np.linspace(front.sample_s, 0.99 * CHIP_S, 40)
    apart = np.interp(instants, *each) - np.interp(instants, *mean)
    assert np.abs(apart).max() < 1e-3 * front.amplitude_v


class _Fast(type(design(FrameSpec(nodes=4, frame_period_s=1.0), 4))):  # type: ignore[misc]
    """A front end whose followers don't slew."""

    @property
    def follower_slew_v_per_s(self) -> float:
        return 1e9


def test_noise_is_that_of_its_sources() -> None:
    """Against sums by hand: amplifier and divider times noise gain, resistors, followers."""
    front = design(FrameSpec(nodes=16, frame_period_s=1.0), 4)
    stage = front.nodes_stage
    half_ohm, opamp_ohm = 5e3, 3.9e3
    node_ohm = 1 / (1 / front.series_ohm + 2 / front.bias_ohm)
    white = (half_ohm + opamp_ohm) * stage.noise_gain**2
    white += stage.feedback_ohm + 16 * stage.input_ohm * stage.gain**2
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


def test_a_chips_only_sample_is_late() -> None:
    front = design(FrameSpec(nodes=900, chip_s=2e-6, frame_period_s=1.0), 1)
    assert front.sample_s == LATE_SAMPLE * 2e-6
