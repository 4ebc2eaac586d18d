# SPDX-License-Identifier: Apache-2.0

"""A robot lies down on its skin: from 0 to 100 % touched in one frame, and what is published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from tactile_cdma.wire._protocol import SyncMode

TOUCHED_S, RELEASED_S, END_S = 2.0, 3.0, 7.0
"""When all nodes are touched, and released; chosen: before, each has told by a heartbeat that it is
there, and afterwards all transmit at once again."""
PRESSURE_PA = 30e3


@dataclass(frozen=True)
class Hug:
    """Holds shares of the taxels in each frame.

    t_s: (f,) since the touch. certain: (f,) whose value is without doubt: those whose turn it is.
    right: (f,) whose value is what the node measures, within its threshold, certain or UNHEARD.
    false: values without doubt, of all frames, that are not right. touched_s, released_s: until all
    are right, and then certain again.
    """

    t_s: NDArray[np.float64]
    certain: NDArray[np.float64]
    right: NDArray[np.float64]
    false: int
    touched_s: float
    released_s: float


def touch(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
    """Press a skin, Pa: nothing, then all of it, here more, there less, then nothing."""
    count = len(skin.positions_m)
    pressed = TOUCHED_S <= t_s < RELEASED_S
    return np.where(pressed, PRESSURE_PA, 0.0) * np.linspace(0.5, 1.0, count)


def hug(values: dict[str, Value]) -> Hug:
    """Have a skin of these parameters hugged, in simulated time."""
    SCENES["press"] = touch
    options = SimOptions.from_url("sim://?scene=press&seed=1&noise=0.01")
    config, now_s = SkinConfig.of(values), 0.0
    spec = config.spec
    digitizer = VirtualDigitizer(options, lambda: now_s)
    pipeline, session = Pipeline(config), Session(config)
    digitizer.receive(session.open())
    frames: list[TactileFrame] = []
    while now_s < END_S:
        now_s += spec.frame_period_s
        digitizer.advance()
        frames += pipeline.feed(digitizer.take(1 << 20), now_s)
        digitizer.receive(session.watch(pipeline, now_s) + session.ask(pipeline, now_s))
    sent = truth(options, Setup(spec, config.samples_per_chip, SyncMode.DRIVE, True))
    measured = dict(zip(range(len(frames) + 2), sent, strict=False))
    t_s, shares, false = [], [], 0
    for frame in frames:
        true = measured[frame.sequence]
        certain = frame.readings.status & (Status.LOW_SNR | Status.STALE) == 0
        off_v = np.abs(frame.readings.voltage_v - config.adc.voltage(true.codes))
        right = off_v < 2.5 * config.adc.lsb_v
        false += int((certain & ~right).sum())
        t_s.append(true.start_s - TOUCHED_S)
        shares.append((certain.mean(), right.mean(), (certain & right).mean()))
    at, (certain_share, right_share, both) = np.array(t_s), np.array(shares).T
    return Hug(
        *(at, certain_share, right_share, false),
        _until(at, right_share == 1, 0.0),
        _until(at, both == 1, RELEASED_S - TOUCHED_S),
    )


def _until(t_s: NDArray[np.float64], well: NDArray[np.bool_], begin_s: float) -> float:
    """Time from an event until all is well again, s."""
    later = np.flatnonzero(well & (t_s > begin_s))
    return float(t_s[later[0]] - begin_s) if later.size else float("nan")
