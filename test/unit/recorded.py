# SPDX-License-Identifier: Apache-2.0

"""Raw captures of simulated skins, made as fast as it can be."""

from dataclasses import dataclass
from pathlib import Path

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions


def record(path: Path, options: SimOptions, seconds: float) -> None:
    """What tactile-cdma record writes in so many seconds of the skin's time."""
    clock = _Clock()
    digitizer = VirtualDigitizer(options, clock)
    digitizer.receive(Session(SkinConfig.of({})).open())
    with path.open("wb") as file:
        while clock.now_s < seconds:
            clock.now_s += 0.02
            digitizer.advance()
            file.write(digitizer.take(1 << 20))
    assert digitizer.packets_dropped == 0


@dataclass
class _Clock:
    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s
