# SPDX-License-Identifier: Apache-2.0

"""A driver that does not get every frame of emulated firmware, compared with one that does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import is_certain
from tactile_cdma.wire.messages import Quiet, Samples
from tactile_cdma.wire.packets import PacketParser

NEAR_LSB = 3.5
"""LSB by which a silent node's value may be off where nodes repeat: three thresholds, and half."""


class LossyDriver:
    """Decodes a stream of which frames are lost, and asks all nodes to speak as a driver does.

    pipeline: its own. lost: frames whose first packet was damaged.
    after `compare`: wrong, certain words that the other one did not hear; unflagged, certain
    readings that are none of the last word; most_blind, frames in a row, most, in which a taxel was
    in doubt that the other one was sure of.
    """

    def __init__(self, config: SkinConfig, session: Session, every: int) -> None:
        """every: so many frames one is lost."""
        self.pipeline, self.lost = Pipeline(config), 0
        self.wrong = self.unflagged = self.most_blind = 0
        self._session, self._every, self._marks = session, every, 0
        self._parser, self._rest = PacketParser(), b""
        self._frames: list[TactileFrame] = []

    def feed(self, data: bytes, now_s: float) -> bytes:
        """Take what the digitizer sent; returns what to send to it."""
        *runs, self._rest = (self._rest + data).split(b"\0")
        frames = self.pipeline.feed(b"".join(map(self._arrived, runs)), now_s)
        self._frames += frames
        return self._session.ask(self.pipeline, now_s) if frames else b""

    def _arrived(self, run: bytes) -> bytes:
        """Return a packet as it arrives."""
        for packet in self._parser.feed(run + b"\0"):
            if isinstance(packet, Samples | Quiet) and packet.sync:
                self._marks += 1
                if self._marks % self._every == 0:
                    self.lost += 1
                    return run[:-1] + b"\0"
        return run + b"\0"

    def compare(self, heard: Iterable[TactileFrame]) -> None:
        """Compare with all frames of the stream."""
        all_frames = {round(frame.t_start * 1e5): frame for frame in heard}
        lsb_v, blind = self.pipeline.config.adc.lsb_v, 0
        for frame in self._frames:
            true = all_frames[round(frame.t_start * 1e5)]
            words, others = frame.words, true.words
            same = others.active & (words.codes == others.codes)
            sure = words.active & ~words.doubtful & ~others.doubtful
            self.wrong += int(np.sum(sure & ~same))
            certain, truly = _certain(frame), _certain(true)
            off_v = np.abs(frame.readings.voltage_v - true.readings.voltage_v)
            self.unflagged += int(np.sum(certain & truly & (off_v > NEAR_LSB * lsb_v)))
            blind = blind + 1 if np.any(truly & ~certain) else 0
            self.most_blind = max(self.most_blind, blind)


def _certain(frame: TactileFrame) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    readings = frame.readings
    return np.asarray(is_certain(readings.status) & np.isfinite(readings.voltage_v))
