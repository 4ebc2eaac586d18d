# SPDX-License-Identifier: Apache-2.0

"""The simulator's options as SkinBatch takes or refuses them, an example of each."""

ONE_BY_ONE = {
    "sensor": ("sensor=paper", ""),
    "hysteresis": ("sensor=paper", "sensor=paper&hysteresis=6"),
    "calibration": ("", "calibration={own}"),
    "mismatch": ("", "mismatch=0.1"),
    "sensor_noise": ("sensor_noise=0.01", "sensor_noise=0.05"),
    "dead": ("", "dead=3,9"),
    "dead_after": ("dead=3", "dead=3&dead_after=0.2"),
    "stuck": ("", "stuck=2,5"),
    "threshold": ("", "threshold=0"),
    "heartbeat": ("heartbeat=5", "heartbeat=0"),
    "speaks": ("heartbeat=0", "heartbeat=0&speaks=change"),
    "start_phase": ("dead=3&dead_after=0.2", "dead=3&dead_after=0.2&start_phase=0.9"),
    "seed": ("mismatch=0.1", "mismatch=0.1&seed=2"),
}
"""Options that are of each environment: two URLs that differ in one of them."""

OF_THE_LINE = (
    *("scene=press", "noise=0.5", "offset=0.4", "stretch=0.1", "jitter=0.1", "clock_spread=0.001"),
    *("delay_spread=0.3", "rail=2.0", "adc_bits=8", "warming=20.0"),
)
"""Options that SkinBatch has to refuse."""
