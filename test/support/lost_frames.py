# SPDX-License-Identifier: Apache-2.0

"""Skins of which frames are lost, in virtual time: what a driver asks for, and what it claims."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tactile_cdma.base.arrays import Floats, Floats32
from tactile_cdma.config.parameters import Value, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import is_certain, is_in_service
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import Waveform
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import BY_THE_SECOND, SimOptions
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import Ask, Command, Packet, Quiet, Samples

from .simulated import Truth

CONFIG = Path(__file__).resolve().parents[2] / "config"
SIMULATED: dict[str, Value] = {"port": "sim://", "amplitude_mv": 300.0}
SKINS: dict[str, dict[str, Value]] = {
    "16": {},
    "900": read_file(CONFIG / "thousand_skin.yaml") | SIMULATED,
    "sparse": read_file(CONFIG / "sparse_skin.yaml") | SIMULATED,
}
NOISE_V = 0.4
STEP_S = 5e-4
"""s between two looks of the host."""
TOLD_LSB = 3.5
"""LSB by which a silent node's value may be off where nodes repeat: three thresholds, and half."""


class DamagedDigitizer(VirtualDigitizer):
    """A digitizer, some of whose frames arrive damaged.

    harmed: marked packets that are still to be damaged.
    """

    harmed = 0

    def _send(self, packet: Packet) -> None:
        before = self.pending
        super()._send(packet)
        if self.harmed and isinstance(packet, Samples | Quiet) and packet.sync:
            self.harmed -= 1
            self._output[before + 8] ^= 0x55


class LossyDigitizer(DamagedDigitizer):
    """The same in virtual time.

    now_s: its time. knows: the command to ask all nodes; firmware of before does not. deaf: it does
    not get it. asked_s: when it was sent. kinds: of the commands. noisy: frames in which all are
    asked, and whose words noise drowns.
    """

    def __init__(self, options: SimOptions, knows: bool = True) -> None:
        self.now_s, self.knows, self.deaf = 0.0, knows, False
        self.asked_s: list[float] = []
        self.kinds: set[type[Command]] = set()
        self.noisy = 0
        super().__init__(options, lambda: self.now_s, self)

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        """As a Disturbance: nothing."""
        return iter(())

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        """As a Disturbance: noise."""
        if not (self.noisy and frame.asked):
            return volts
        self.noisy -= 1
        return volts + np.random.default_rng(1).normal(0, NOISE_V, len(volts)).astype(np.float32)

    def _obey(self, command: Command) -> None:
        self.kinds.add(type(command))
        if isinstance(command, Ask):
            self.asked_s.append(self.now_s)
            if self.deaf:
                return
            if not self.knows:
                self._send(command.ack(Result.UNKNOWN_COMMAND))
                return
        super()._obey(command)


class LossyLink:
    """A digitizer and what a driver does with it; compares what it claims with the truth.

    frames: published. wrong: words that nobody sent. unflagged: readings that nobody doubts and
    that are not of the word that their node sent last.
    """

    def __init__(
        self, name: str, scene: str = "presses", knows: bool = True, heartbeat: int = BY_THE_SECOND
    ) -> None:
        """name: of SKINS."""
        options = SimOptions(scene=scene, seed=3, heartbeat=heartbeat)
        self.line = LossyDigitizer(options, knows)
        self.config = config = SkinConfig.of(SKINS[name])
        self.pipeline, self.session = Pipeline(config), Session(config)
        self.frames: list[TactileFrame] = []
        self.wrong = self.unflagged = 0
        self.line.receive(self.session.open())
        self._truth = Truth(self.line)
        self._number = -1  # of the newest frame since START
        self._said = np.full(config.spec.nodes, -1)  # code

    def go_on(self, seconds: float) -> list[TactileFrame]:
        """Let time pass; returns the frames."""
        line, before = self.line, len(self.frames)
        for _ in range(round(seconds / STEP_S)):
            line.now_s += STEP_S
            line.advance()
            self._read(line.take(line.pending))
            line.receive(self.session.watch(self.pipeline, line.now_s))
        return self.frames[before:]

    def _read(self, data: bytes) -> None:
        """Take bytes in as `Driver` does."""
        line, pipeline = self.line, self.pipeline
        pipeline.stream.give(data, line.now_s, False)
        needs_bytes = False
        while not needs_bytes:
            event = pipeline.stream.next()
            if (frame := pipeline.take(event)) is not None:
                line.receive(self.session.ask(pipeline, line.now_s))
                self._judge(frame)
            needs_bytes = event.needs_bytes

    def _judge(self, frame: TactileFrame) -> None:
        self.frames.append(frame)
        start_s, period_s = self.line.started_s, self.config.spec.frame_period_s
        number = round((frame.t_start - start_s) / period_s)
        for passed in range(self._number + 1, number + 1):
            true = self._truth[passed]
            self._said[true.active] = true.codes[true.active]
        self._number, words = number, frame.words
        sure = words.active & ~words.doubtful
        self.wrong += int(np.count_nonzero(sure & ~(true.active & (words.codes == true.codes))))
        readings, source = frame.readings, self.config.layout.nodes - 1
        off_v = np.abs(readings.voltage_v - self.config.adc.voltage(self._said)[source])
        claimed = is_certain(readings.status) & np.isfinite(readings.voltage_v)
        off = off_v > TOLD_LSB * self.config.adc.lsb_v
        self.unflagged += int(np.count_nonzero(claimed & (off | (self._said[source] < 0))))


def is_blind(frame: TactileFrame) -> bool:
    """Whether a taxel in service has no certain reading."""
    readings = frame.readings
    sure = is_certain(readings.status) & np.isfinite(readings.pressure_pa)
    return bool(np.any(is_in_service(readings.status) & ~sure))


def blind(frames: list[TactileFrame]) -> int:
    """How many frames are blind."""
    return sum(map(is_blind, frames))
