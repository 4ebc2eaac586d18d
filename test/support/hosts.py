# SPDX-License-Identifier: Apache-2.0

"""The host's end of a port: a driver that is watched, and a session in virtual time."""

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import WAITING, Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.packets import PacketParser

CONFIG = SkinConfig.of({})


class Watch:
    """Collects what a driver reports."""

    def __init__(self) -> None:
        self.frames: list[TactileFrame] = []
        self.problems: list[str | None] = []

    def driver(self, url: str, config: SkinConfig = CONFIG) -> Driver:
        return Driver(config, url, 2_000_000, self.frames.append, self.note)

    def note(self, problem: str | None) -> None:
        if problem != WAITING:
            self.problems.append(problem)


class Talk:
    """A session, its pipeline and a digitizer, a step of time after the other."""

    def __init__(self, digitizer_id: str, config: SkinConfig | None = None) -> None:
        self.config = config or SkinConfig.of({"digitizer_id": digitizer_id})
        self.session, self.pipeline = Session(self.config), Pipeline(self.config)
        self.now_s = 0.0
        self.sent: list[object] = []
        self._heard = PacketParser()
        self.digitizer = VirtualDigitizer(clock=lambda: self.now_s)

    def exchange(self, seconds: float) -> list[TactileFrame]:
        """What the driver does with a port, from opening to closing it."""
        self.open()
        frames = self.go_on(seconds)
        self._send(self.session.close())
        return frames

    def open(self) -> None:
        self._send(self.session.open())

    def power_up(self, options: SimOptions) -> None:
        """Have another digitizer, to which nobody has talked yet."""
        self.digitizer = VirtualDigitizer(options, lambda: self.now_s)
        self.session = Session(self.config)

    def skip(self) -> None:
        """Lose what the digitizer has sent until now."""
        self.digitizer.advance()
        self.digitizer.take(self.digitizer.pending)

    def go_on(
        self, seconds: float, step_s: float = 0.01, late_s: float = 0.0
    ) -> list[TactileFrame]:
        """What its loop does; late_s: how late it reads."""
        frames = []
        for _ in range(round(seconds / step_s)):
            self.now_s += step_s
            self.digitizer.advance()
            data, t_host = self.digitizer.take(1 << 20), self.now_s + late_s
            frames += self.pipeline.feed(data, t_host, late_s > 0)
            self._send(self.session.watch(self.pipeline, self.now_s))
        return frames

    def _send(self, data: bytes) -> None:
        self.sent += [type(packet) for packet in self._heard.feed(data)]
        self.digitizer.receive(data)
