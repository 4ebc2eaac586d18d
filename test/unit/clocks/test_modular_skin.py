# SPDX-License-Identifier: Apache-2.0

"""A simulated skin whose nodes have clocks of their own, through the bytes of its digitizer."""

import numpy as np

from tactile_cdma.clocks.decorrelate import Decorrelator
from tactile_cdma.clocks.node_clocks import needs_decorrelation
from tactile_cdma.clocks.roll_call import RollCallListener
from tactile_cdma.code.separate import NodeLevels, separate
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Received, RollCall, Samples, Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from tactile_cdma.words.decode import decode
from test.support.simulated import Truth

URL = (
    "sim://?nodes=15&order=32&chip_us=20&samples_per_chip=4&clock_spread=0.005&delay_spread=0.5"
    "&threshold=0&scene=presses&noise=0.02&offset=0.4&speed=0&seed=3"
)


def frames_of(received: list[Received]) -> list[tuple[bool, np.ndarray]]:
    """Flag CALLED and counts of each marked frame, to the start of the next."""
    packets = [packet for packet in received if isinstance(packet, Samples)]
    counts = np.concatenate([packet.counts for packet in packets])
    assert packets[-1].first_index + packets[-1].counts.size == counts.size  # none is missing
    marks = [packet for packet in packets if packet.sync]
    cuts = np.split(counts, [packet.first_index for packet in marks])[1:]
    return [(packet.called, cut) for packet, cut in zip(marks, cuts, strict=True)][:-1]


def test_a_roll_call_is_all_it_takes() -> None:
    digitizer, parser, writer = (
        VirtualDigitizer(SimOptions.from_url(URL)),
        PacketParser(),
        PacketWriter(),
    )
    received: list[Received] = []
    for command in (Start(), RollCall()):
        digitizer.receive(writer.encode(command))
        digitizer.advance(120_000)
        received += parser.feed(digitizer.take(1 << 30))
    spec, per_chip, info = digitizer.setup.spec, 4.0, digitizer.info()
    listener = RollCallListener(spec, per_chip)
    decorrelator, plain_errors, checked = None, 0, 0
    called, truths = 0, Truth(digitizer)
    for number, (by_name, counts) in enumerate(frames_of(received)):
        volts = info.volts(counts)
        gap = volts[listener.samples :]
        volts = volts - gap.mean()
        if by_name:
            heard = listener.hear(called, volts, float(gap.std()))
            assert not heard.refusal
            called += 1
        elif called:
            if decorrelator is None:
                clocks = listener.clocks()
                true = digitizer.options.clocks.at(spec.nodes, 0.0)
                assert clocks.known.all()
                assert clocks.moved_chips(true, spec) < 0.2
                assert needs_decorrelation(spec, clocks)
                decorrelator = Decorrelator(spec, clocks, per_chip)
                assert not decorrelator.unresolved.size
            truth = truths[number]
            noise_v = float(gap.std()) * float(np.sqrt(np.square(decorrelator.noise_gain).mean()))
            words = decode(NodeLevels(decorrelator.estimate(volts), noise_v), spec)
            assert np.array_equal(words.active, truth.active)
            assert np.array_equal(words.codes, truth.codes)
            assert words.noise_rms_v > 0
            chips = volts[: 4 * spec.chips].reshape(spec.bits, spec.order, 4).mean(axis=2)
            plain = decode(separate(chips, spec), spec)
            plain_errors += np.count_nonzero(plain.codes != truth.codes)
            checked += 1
    assert called == spec.nodes
    assert checked >= 3
    assert plain_errors > checked
