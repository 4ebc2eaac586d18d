# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Raw captures of simulated skins, made as fast as it can be."""

from dataclasses import dataclass
from pathlib import Path

from tactile_cdma.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.skin_config import SkinConfig


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
