# SPDX-License-Identifier: Apache-2.0

"""Identification from recorded loading cycles: exact where possible, else refused."""

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pytest

from tactile_cdma.base.errors import CalibrationError
from tactile_cdma.calibrating.identify import LEAST_POINTS, Identified, identify
from tactile_cdma.readings.calibration import AdcScale, Calibration
from tactile_cdma.readings.dynamics import Compensator, Dynamics, Hysteresis, Lag
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.sensor import PAPER_DYNAMICS

SECONDS = 64.0
HELD_OUT = 2 / 3


@dataclass(frozen=True)
class Record:
    """A recording of a simulated skin under loading cycles, and the true pressure."""

    calibration: Calibration
    t_s: np.ndarray
    reference_pa: np.ndarray
    voltage_v: np.ndarray

    @classmethod
    def of(cls, query: str) -> "Record":
        options = SimOptions.from_url(f"sim://?scene=cycles&sensor=paper&{query}")
        setup, adc = options.setup(), AdcScale()
        count = round(SECONDS / setup.spec.frame_period_s)
        frames = list(islice(truth(options, setup), count))
        nodes = setup.spec.nodes
        return cls(
            Calibration(options.sensors.curves(nodes), np.zeros(nodes, dtype=bool)),
            np.array([frame.start_s for frame in frames]),
            np.array([frame.pressure_pa[0] for frame in frames]),
            np.array([adc.voltage(frame.codes) for frame in frames]),
        )

    @property
    def pressure_pa(self) -> np.ndarray:
        curves = self.calibration.curves
        return np.array([curves.pressure(row.astype(np.float32)) for row in self.voltage_v])

    def removed(self, dynamics: Dynamics) -> float:
        """Share of the rms error of all nodes that compensation removes in the last third."""
        nodes = self.voltage_v.shape[1]
        compensator = Compensator(dynamics, self.calibration.curves.range_pa)
        valid, static_pa = np.ones(nodes, dtype=bool), self.pressure_pa
        found_pa = [
            compensator.update(row, valid, t)
            for row, t in zip(static_pa, self.t_s.tolist(), strict=True)
        ]
        late = slice(round(HELD_OUT * len(self.t_s)), None)
        before, after = (
            np.sqrt(np.mean((np.array(x) - self.reference_pa[:, None])[late] ** 2))
            for x in (static_pa, found_pa)
        )
        return float(1 - after / before)


@pytest.fixture(scope="module")
def record() -> Record:
    return Record.of("")


@pytest.fixture(scope="module")
def found(record: Record) -> Identified:
    return identify(record.t_s, record.reference_pa, record.pressure_pa)


def test_the_dynamics_of_the_sensor_are_found(found: Identified) -> None:
    assert found.dynamics.rise_s == pytest.approx(PAPER_DYNAMICS.rise_s, rel=0.05)
    assert found.dynamics.fall_s < 0.01  # less than a frame: no more can be told
    # The same loops, though of plays of other widths.
    paths_pa = np.array([[120e3, 60e3, 20e3, 80e3, 50e3]]).T
    loops = []
    for dynamics in (PAPER_DYNAMICS, found.dynamics):
        hysteresis = Hysteresis(dynamics, 1)
        loops.append(np.array([hysteresis.update(row) for row in paths_pa]))
    np.testing.assert_allclose(loops[1] - paths_pa, loops[0] - paths_pa, atol=500)


def test_most_of_the_error_on_cycles_not_seen_is_removed(record: Record, found: Identified) -> None:
    assert found.removed >= 0.75
    assert found.removed == pytest.approx(record.removed(found.dynamics), abs=0.02)


@pytest.mark.parametrize("drift", [0.9, 1.1])
def test_a_sensor_that_has_changed_since_is_still_helped(
    record: Record, found: Identified, drift: float
) -> None:
    changed = replace(
        found.dynamics,
        rise_s=found.dynamics.rise_s * drift,
        weights=tuple(weight * drift for weight in found.dynamics.weights),
    )
    assert record.removed(changed) >= 0.7


def test_mismatch_noise_and_broken_nodes_do_not_mislead() -> None:
    record = Record.of("mismatch=0.05&sensor_noise=0.003&stuck=4,5&seed=3")
    again = identify(record.t_s, record.reference_pa, record.pressure_pa)
    assert again.dynamics.rise_s == pytest.approx(PAPER_DYNAMICS.rise_s, rel=0.05)
    assert again.cycles == 8
    assert again.removed >= 0.6


@pytest.mark.parametrize("late_s", [-0.1, 0.2])
def test_a_reference_whose_clock_is_off_is_put_right(
    record: Record, found: Identified, late_s: float
) -> None:
    """Or the lag would be taken for an offset, and the other way round."""
    reference_pa = np.interp(record.t_s - late_s, record.t_s, record.reference_pa)
    again = identify(record.t_s, reference_pa, record.pressure_pa, uncertain_s=0.3)
    assert again.late_s == pytest.approx(late_s, abs=0.003)
    assert again.dynamics.rise_s == pytest.approx(found.dynamics.rise_s, rel=0.05)
    assert again.removed >= 0.75


def test_missing_readings_are_left_out(record: Record, found: Identified) -> None:
    pressure_pa = record.pressure_pa
    pressure_pa[::7] = np.nan
    pressure_pa[:, 3] = np.nan
    again = identify(record.t_s, record.reference_pa, pressure_pa)
    assert again.dynamics.rise_s == pytest.approx(found.dynamics.rise_s, rel=0.05)
    assert again.removed >= 0.7


def synthetic(t_s: np.ndarray, reference_pa: np.ndarray, dynamics: Dynamics) -> np.ndarray:
    lag, hysteresis = Lag(dynamics.rise_s, dynamics.fall_s), Hysteresis(dynamics, 1)
    steps = np.diff(t_s, prepend=t_s[0])
    return np.array(
        [
            hysteresis.update(lag.update(np.array([p]), step))
            for p, step in zip(reference_pa, steps, strict=True)
        ]
    )


def test_a_sensor_with_other_dynamics_is_found_too() -> None:
    """Slow in both directions, wide loops, uneven frames; exact but for the widths."""
    rng = np.random.default_rng(1)
    t_s = np.cumsum(rng.uniform(0.01, 0.04, 2000))
    reference_pa = 50e3 * (1 - np.cos(2 * t_s)) * (0.6 + 0.4 * np.sin(0.3 * t_s))
    dynamics = Dynamics(0.3, 0.1, (0.15, 0.65), (0.3, 0.2))
    found = identify(t_s, reference_pa, synthetic(t_s, reference_pa, dynamics))
    assert found.dynamics.rise_s == pytest.approx(0.3, rel=0.02)
    assert found.dynamics.fall_s == pytest.approx(0.1, rel=0.05)
    weights = dict(zip(found.dynamics.widths, found.dynamics.weights, strict=True))
    assert weights[0.15] == pytest.approx(0.3, abs=0.05)
    assert weights[0.65] == pytest.approx(0.2, abs=0.05)


T_S = 0.02 * np.arange(3000)
LOADS_PA = 50e3 * (1 - np.cos(2 * T_S))


@pytest.mark.parametrize(
    ("t_s", "reference_pa", "words"),
    [
        (T_S[:150], LOADS_PA[:150], f"150 frames; .* {LEAST_POINTS}"),
        (T_S[::-1], LOADS_PA, "times must rise"),
        (T_S, LOADS_PA * 1e-3, "reach 100 Pa; .* in Pa"),
        (T_S, np.full(3000, 40e3), "hardly changes"),
        (T_S, 50e3 * (1 - np.cos(0.15 * T_S)), "rise and fall 2 times"),
    ],
)
def test_records_that_cannot_tell_are_refused(
    t_s: np.ndarray, reference_pa: np.ndarray, words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        identify(t_s, reference_pa, reference_pa[:, None])


def test_loads_that_change_too_slowly_are_refused() -> None:
    """Quantisation hides what a lag does to loads of a minute."""
    t_s = 0.2 * np.arange(3000)
    reference_pa = 50e3 * (1 - np.cos(2 * np.pi * t_s / 120))
    read_pa = np.round(reference_pa / 2e3) * 2e3
    with pytest.raises(CalibrationError, match="too slowly"):
        identify(t_s, reference_pa, read_pa[:, None])


def test_a_reference_of_other_loads_is_refused() -> None:
    with pytest.raises(CalibrationError, match="belong together"):
        identify(T_S, LOADS_PA, 50e3 * (1 - np.cos(2.7 * T_S - 1.0))[:, None])


def test_a_skin_that_feels_nothing_or_only_noise_has_no_dynamics(record: Record) -> None:
    """Dynamics fitted to either remove at most a few per cent of the error."""
    noise_pa = np.abs(np.random.default_rng(0).normal(50e3, 30e3, len(record.t_s)))
    for reference_pa, felt_pa in (
        (record.reference_pa, 0.0 * record.pressure_pa),
        (noise_pa, record.pressure_pa),
    ):
        with pytest.raises(CalibrationError, match="belong together"):
            identify(record.t_s, reference_pa, felt_pa)


def test_a_sensor_that_is_right_needs_no_dynamics(record: Record) -> None:
    with pytest.raises(CalibrationError, match="hardly better: 0 Pa rms before"):
        identify(record.t_s, record.reference_pa, record.reference_pa[:, None])
