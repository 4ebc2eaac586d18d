# SPDX-License-Identifier: Apache-2.0

"""What simulated skins send: raw captures, an oscilloscope's view of the line, streams of bytes."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.recording.recording_file import Recorder, describe
from tactile_cdma.sim.channel import Channel, first_sample, point_samples
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeFrame, Turns
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import Result, Signs, SyncMode
from tactile_cdma.wire.messages import (
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Received,
    Samples,
    Start,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter


def record(path: Path, options: SimOptions, seconds: float) -> None:
    """What tactile-cdma record writes in so many seconds of the skin's time."""
    with path.open("wb") as file:
        for data, _ in told(options, seconds):
            file.write(data)


def recording(path: Path, options: SimOptions, seconds: float, **parameters: object) -> Path:
    """The same as a recording with its times and these parameters."""
    with Recorder(path, "sim://", 9600, {"nodes": 16} | parameters) as recorder:
        begin_s = describe(path).monotonic_ns * 1e-9
        for data, now_s in told(options, seconds):
            recorder.write(data, begin_s + now_s)
    return path


def told(
    options: SimOptions,
    seconds: float,
    config: SkinConfig | None = None,
    kind: type[VirtualDigitizer] = VirtualDigitizer,
    opening: bytes = b"",
) -> Iterator[tuple[bytes, float]]:
    """What a host reads, and when, in so many seconds of the time of a skin that it sets up.

    opening: commands by which it does so, other than the driver's.
    """
    now_s = 0.0
    digitizer = kind(options, lambda: now_s)
    digitizer.receive(opening or Session(config or SkinConfig.of({})).open())
    while now_s < seconds:
        now_s += 0.02
        digitizer.advance()
        yield digitizer.take(1 << 20), now_s
    assert digitizer.packets_dropped == 0


class OtherwiseScrambled(VirtualDigitizer):
    """A digitizer that repeats what the host set it to, while its nodes scramble otherwise."""

    def _configure(self, command: Configure) -> Result:
        scrambled = command.frame.signs == Signs.SCRAMBLED
        self.options = replace(self.options, scramble=not scrambled)
        return super()._configure(command)

    def info(self) -> Info:
        info = super().info()
        told = {Signs.SEEDED: Signs.SCRAMBLED, Signs.SCRAMBLED: Signs.SEEDED}[info.frame.signs]
        return replace(info, frame=replace(info.frame, signs=told))


class Truth:
    """What the nodes of a virtual digitizer measure and send in its present set-up, by frame.

    Number 0 is START's. What a program pressed is not remembered: of the scene "external" this is
    the untouched skin.
    """

    def __init__(self, digitizer: VirtualDigitizer) -> None:
        turns = Turns(digitizer.turns.divisions)  # the stream begins those asked for
        self._coming = truth(digitizer.options, digitizer.setup, turns)
        self._known: list[NodeFrame] = []

    def __getitem__(self, number: int) -> NodeFrame:
        self._known += islice(self._coming, max(0, number + 1 - len(self._known)))
        return self._known[number]


def scope_capture(
    spec: FrameSpec,
    frames: Sequence[tuple[NDArray[np.int64], NDArray[np.bool_]]],
    rate_hz: float,
    channel: Channel | None = None,
    lead_s: float = 1e-3,
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """What an oscilloscope on the line records of some frames, as in the paper's experiments.

    frames: (codes, active) of each frame, (n,) each. lead_s: recorded before the first frame, s.
    Returns time_s (m,) float64, 0 at the first sample, and volts (m,) float32.
    """
    channel = channel or Channel()
    volts = []
    first = 0
    for number, (codes, active) in enumerate(frames):
        start_s = lead_s + number * spec.frame_period_s
        stop = int(first_sample(start_s + spec.frame_period_s, rate_hz))
        rng = np.random.default_rng([seed, number])
        edges_s = start_s + channel.edges(spec, rng)
        levels = frame_levels(line_chips(spec, codes, active), spec)
        line_v = point_samples(levels, edges_s, rate_hz, first, stop)
        volts.append(channel.volts(channel.digitize(line_v, spec, rng), spec))
        first = stop
    return np.arange(first) / rate_hz, np.concatenate(volts)


def configuration(config: SkinConfig, quiet_uv: int = 0) -> Configure:
    """What the driver would ask of the digitizer."""
    return Configure(
        FrameLayout.of(config.spec, config.samples_per_chip),
        SyncMode.NONE if config.timing == GAP else SyncMode.DRIVE,
        config.samples_per_chip == 1,
        quiet_uv,
    )


def introduction(config: SkinConfig, volts_per_count: float = 1e-3, **changes: int) -> Info:
    """What a digitizer says that is set like this."""
    asked, rate_hz = configuration(config), config.samples_per_chip / config.spec.chip_s
    return Info(
        frame=asked.frame,
        sample_rate_uhz=round(rate_hz * 1e6),
        volts_per_count=volts_per_count,
        sync_mode=asked.sync_mode,
        integrated=asked.integrated,
        **changes,
    )


def started(config: SkinConfig, url: str) -> VirtualDigitizer:
    """A digitizer that was configured and started, and whose time stands still."""
    digitizer = VirtualDigitizer(SimOptions.from_url(f"{url}&speed=0"), clock=lambda: 0.0)
    writer = PacketWriter()
    for command in (configuration(config), GetInfo(), Start()):
        digitizer.receive(writer.encode(command))
    return digitizer


def truth_of(config: SkinConfig, url: str) -> Truth:
    """What the nodes send of which `stream` gives the bytes."""
    return Truth(started(config, url))


def stream(config: SkinConfig, url: str, frames: int) -> bytes:
    """What a digitizer sends for so many frames after being configured and started."""
    digitizer = started(config, url)
    end_s = frames * config.spec.frame_period_s
    data, parser, now_s = b"", PacketParser(), 0.0
    while now_s < end_s:
        digitizer.advance(4096)
        chunk = digitizer.take(4096)
        for packet in parser.feed(chunk):
            if isinstance(packet, Samples):
                now_s = packet.device_time_us * 1e-6
        data += chunk
    return data


def packets_of(config: SkinConfig, url: str, frames: int) -> list[Received]:
    """The same as packets."""
    return PacketParser().feed(stream(config, url, frames))


def decoded(
    config: SkinConfig, packets: Iterable[Any], t_host: float = 0.0
) -> tuple[Pipeline, list[TactileFrame]]:
    """What the driver makes of packets, which are read one by one."""
    pipeline, writer = Pipeline(config), PacketWriter()
    return pipeline, [f for p in packets for f in pipeline.feed(writer.encode(p), t_host)]


def run(config: SkinConfig, data: bytes) -> list[TactileFrame]:
    """What the driver makes of bytes, read at once."""
    return Pipeline(config).feed(data, 0.0)
