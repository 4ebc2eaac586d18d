# SPDX-License-Identifier: Apache-2.0

"""The bytes of a simulated digitizer, and the pipeline's frames from them."""

from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import Configure, FrameLayout, GetInfo, Samples, Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter


def configuration(config: SkinConfig) -> Configure:
    """What the driver would ask of the digitizer."""
    return Configure(
        FrameLayout.of(config.spec, config.samples_per_chip),
        SyncMode.NONE if config.timing == GAP else SyncMode.DRIVE,
        config.samples_per_chip == 1,
    )


def stream(config: SkinConfig, url: str, frames: int) -> bytes:
    """What a digitizer sends for so many frames after being configured and started."""
    digitizer = VirtualDigitizer(SimOptions.from_url(f"{url}&speed=0"), clock=lambda: 0.0)
    writer = PacketWriter()
    for command in (configuration(config), GetInfo(), Start()):
        digitizer.receive(writer.encode(command))
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


def run(config: SkinConfig, data: bytes, chunk: int | None = None) -> list[TactileFrame]:
    pipeline = Pipeline(config)
    chunk = chunk or len(data)
    return [
        frame
        for start in range(0, len(data), chunk)
        for frame in pipeline.feed(data[start : start + chunk], start * 1e-6)
    ]
