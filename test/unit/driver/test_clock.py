# SPDX-License-Identifier: Apache-2.0

"""Device time to host time, through jitter, stalls, backlogs and slow devices."""

import numpy as np
import pytest

from tactile_cdma.driver.clock import DeviceClock


@pytest.mark.parametrize("drift", [0.0, 80e-6, -80e-6])
@pytest.mark.parametrize("start", [0.0, 3e6])
def test_offset_and_rate_are_found_through_bus_jitter(drift: float, start: float) -> None:
    """USB-like delays of 0.2 ms plus up to 4 ms; device time up to a month."""
    rng, clock = np.random.default_rng(0), DeviceClock()
    for i in range(20_000):
        device = start + i * 2e-3
        delay = 0.2e-3 + rng.exponential(1e-3)
        clock.observe(device, 1000 + (device - start) * (1 + drift) + delay)
    now = start + 40.0
    truth = 1000 + (now - start) * (1 + drift) + 0.2e-3
    assert clock.to_host(now) == pytest.approx(truth, abs=0.1e-3)


def test_never_later_than_any_arrival() -> None:
    rng, clock = np.random.default_rng(1), DeviceClock()
    for i in range(3000):
        device, arrival = i * 5e-3, 7 + i * 5e-3 + rng.exponential(2e-3)
        clock.observe(device, arrival)
        assert clock.to_host(device) <= arrival + 1e-9


def test_wild_arrivals_do_not_bend_the_rate() -> None:
    clock = DeviceClock()
    for i in range(200):
        stall = 3.0 if 100 < i < 140 else 0.0
        clock.observe(i * 0.1, i * 0.1 + stall)
    assert clock.to_host(20.0) == pytest.approx(20.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("stall_s", [0.1, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("age_s", [5.0, 20.0])
@pytest.mark.parametrize("drift", [0.0, 100e-6, -100e-6])
def test_a_stall_moves_no_stamp(drift: float, age_s: float, stall_s: float) -> None:
    """Nothing comes for a while, then all that was held back: meanwhile, and for ever after."""
    rng, clock, worst_s = np.random.default_rng(7), DeviceClock(), 0.0
    for i in range(6000):
        device, true = i * 0.01, 50 + i * 0.01 * (1 + drift)
        arrival = true + rng.exponential(0.5e-3)
        if age_s < arrival - 50 < age_s + stall_s:
            arrival = 50 + age_s + stall_s
        clock.observe(device, arrival)
        if device > 3:
            worst_s = max(worst_s, abs(clock.to_host(device) - true))
    assert worst_s < 1e-3


def test_a_backlog_that_is_worked_off_is_no_slow_device() -> None:
    """A reader that was stopped for 6 s and then reads at three times the pace."""
    clock, worst_s = DeviceClock(), 0.0
    for i in range(6000):
        device = i * 0.01
        clock.observe(device, max(device, 26 + (device - 20) / 3 if device > 20 else 0.0))
        worst_s = max(worst_s, abs(clock.to_host(device) - device))
    assert worst_s < 0.1e-3


def test_a_reader_that_lags_is_no_slow_device() -> None:
    """A host too busy for a while: what buffers hold, 0.8 s, is read so much later."""
    rng, clock, worst_s = np.random.default_rng(8), DeviceClock(), 0.0
    for i in range(6000):
        device = i * 0.01
        lag_s = min(0.8, (device - 20) * 0.8) + rng.uniform(-0.01, 0.01) if 20 < device < 35 else 0
        clock.observe(device, device + max(lag_s, 0), lag_s > 0.01)
        worst_s = max(worst_s, abs(clock.to_host(device) - device))
    assert worst_s < 1e-3


@pytest.mark.parametrize("backlog", [True, False])
def test_a_reader_that_falls_behind_ever_more_is_told_by_what_waits(backlog: bool) -> None:
    """At three quarters of the pace, for 12 s; else it is taken for a device of that pace."""
    clock, worst_s = DeviceClock(), 0.0
    for i in range(3200):
        device = i * 0.01
        late_s = max(0.0, (device - 20) / 3)
        clock.observe(device, device + late_s, backlog and late_s > 0)
        worst_s = max(worst_s, abs(clock.to_host(device) - device))
    assert (worst_s < 1e-3) == backlog


def test_a_device_that_stood_still_is_followed_again() -> None:
    """An emulator that was stopped: it lags from then on, which takes a second to see."""
    clock = DeviceClock()
    for i in range(3000):
        device = i * 0.01
        clock.observe(device, device + 2.0 * (device > 20))
        found_s = clock.to_host(device)
        if not 20 < device < 21:
            assert found_s == pytest.approx(device + 2.0 * (device > 20), abs=1e-3)
    assert clock.take_steps() == 1
    assert clock.take_steps() == 0


@pytest.mark.parametrize("speed", [0.1, 0.5, 0.9])
def test_a_device_slower_than_real_time_is_followed_at_its_pace(speed: float) -> None:
    """A replay at half the speed: what was sent now is stamped now, a minute later as well."""
    rng, clock = np.random.default_rng(3), DeviceClock()
    ages_s = []
    for i in range(6000):
        device, arrival = i * 10e-3, 5 + i * 10e-3 / speed + rng.exponential(1e-3)
        clock.observe(device, arrival)
        ages_s.append(arrival - clock.to_host(device))
    assert min(ages_s) > -0.01
    assert max(ages_s[1000:]) < 0.05


@pytest.mark.parametrize("drift", [0.0, 80e-6, -300e-6])
def test_the_drift_is_told_once_it_is_known(drift: float) -> None:
    """A device's clock that is faster by `drift`, through delays of up to 4 ms."""
    rng, clock = np.random.default_rng(2), DeviceClock()
    for i in range(10_000):
        host = i * 2e-3
        clock.observe(host * (1 + drift), host + rng.exponential(1e-3))
        clock.to_host(host)
        if host < 9.5:
            assert np.isnan(clock.drift_ppm)
    assert clock.drift_ppm == pytest.approx(drift * 1e6, abs=10)


def test_what_piled_up_while_the_host_was_held_up_is_no_slow_device() -> None:
    """5 s of packets that are read within 0.2 s were sent when they were sent."""
    clock = DeviceClock()
    for i in range(3000):
        device = i * 5e-3
        held_up = 5.0 < device < 10.0
        arrival = 10.0 + (device - 5.0) * 0.04 if held_up else device
        clock.observe(device, max(arrival, device))
        assert clock.to_host(device) == pytest.approx(device, abs=1e-3)
