# SPDX-License-Identifier: Apache-2.0

"""Nodes with clocks of their own, from the roll call to the words, through the real byte path."""

import numpy as np
import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import PacketType, Result
from tactile_cdma.wire.messages import Ack, RollCall, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.simulated import Truth

OWN = "&clock_spread=0.01&delay_spread=0.5"


class Bench:
    """A virtual digitizer and a pipeline, as fast as they go."""

    def __init__(self, url: str, **values: Value) -> None:
        self.config = SkinConfig.of({"frame_period_ms": 12.8, **values})
        self.digitizer = VirtualDigitizer(SimOptions.from_url(f"{url}&speed=0"), lambda: 0.0)
        self.pipeline = Pipeline(self.config, background=False)
        self.digitizer.receive(Session(self.config).open())
        self.frames: list[TactileFrame] = []

    def run(self, frames: int) -> None:
        """Until so many periods have passed on the line."""
        config = self.config
        periods = frames * config.spec.frame_period_s
        end = (
            self.pipeline.counters.samples + periods * config.samples_per_chip / config.spec.chip_s
        )
        while self.pipeline.counters.samples < end:
            self.digitizer.advance(1)
            data = self.digitizer.take(self.digitizer.pending)
            self.frames += self.pipeline.feed(data, len(self.frames) * 1e-3)

    def call(self) -> None:
        self.digitizer.receive(PacketWriter(50).encode(RollCall()))

    def right(self, last: int) -> float:
        """Share of words, in so many frame periods up to now, that are right or in doubt.

        In doubt is what two nodes say whose waveforms have become the same: rows of Paley's
        matrix are shifts of each other.
        """
        newest = round(self.frames[-1].t_start / self.config.spec.frame_period_s)
        right, truth = 0, Truth(self.digitizer)
        for frame in self.frames:
            number = round(frame.t_start / self.config.spec.frame_period_s)
            if number > newest - last:
                sent = truth[number]
                words = frame.words
                same = (words.codes == sent.codes) & words.active & sent.active
                right += int((same | words.doubtful).sum())
        return right / (last * self.config.spec.nodes)


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [16, 40])
def test_words_are_right_after_a_roll_call_and_not_before(nodes: int) -> None:
    chip_us = 50.0 if nodes == 16 else 25.0
    bench = Bench(f"sim://?scene=all&threshold=0{OWN}", nodes=nodes, chip_us=chip_us)
    bench.run(20)
    assert not bench.frames or bench.right(10) < 0.8
    bench.call()
    bench.run(nodes + 40)
    report = bench.pipeline.clocks
    assert report is not None and report.decorrelated
    assert report.heard == nodes and report.problem is None
    assert report.spread_chips > 1
    assert bench.right(20) == 1.0
    last = bench.frames[-20:]
    for frame in last:
        assert tuple((np.flatnonzero(frame.words.doubtful) + 1).tolist()) == report.unresolved
    assert len(report.unresolved) <= 2
    steps = np.diff([frame.sequence for frame in last])
    assert (steps == 1).all()


def test_clocks_near_enough_stay_with_plain_correlation() -> None:
    bench = Bench("sim://?scene=all&threshold=0&clock_spread=0.00005&delay_spread=0.02")
    bench.run(10)
    bench.call()
    bench.run(40)
    report = bench.pipeline.clocks
    assert report is not None and report.heard == 16 and not report.decorrelated
    assert bench.right(15) == 1.0


@pytest.mark.slow
def test_clocks_that_drift_are_followed() -> None:
    """A few chips per second and frame end: far beyond what the first roll call has measured."""
    bench = Bench(f"sim://?scene=all&threshold=0{OWN}&drift=0.00005")
    bench.run(8)
    bench.call()
    bench.run(800)  # 10 s: clock errors of 5e-4, or 0.1 chips by the end of a frame
    assert bench.right(100) == 1.0, "0.994 of clocks that are not followed"


def test_a_called_frame_that_is_lost_costs_its_node_only() -> None:
    bench = Bench(f"sim://?scene=all&threshold=0{OWN}")
    bench.run(8)
    bench.call()
    bench.run(6)
    bench.digitizer.advance(1)
    bench.digitizer.take(bench.digitizer.pending)  # never arrives
    bench.run(60)
    report = bench.pipeline.clocks
    assert report is not None and report.decorrelated
    assert 14 <= report.heard <= 15
    assert report.problem is not None and "not heard alone" in report.problem
    assert bench.right(20) > 0.8  # those not heard are guessed


def test_a_roll_call_whose_first_frame_is_lost_teaches_nothing() -> None:
    """A frame taken for the next node's would be believed: rows are shifts of each other."""
    for seed in range(3):
        bench = Bench(f"sim://?scene=all&threshold=0{OWN}&seed={seed}")
        bench.run(8)
        bench.call()
        parser = PacketParser()
        lost = False
        while not lost:
            bench.digitizer.advance(1)
            data = bench.digitizer.take(bench.digitizer.pending)
            called = [p for p in parser.feed(data) if isinstance(p, Samples) and p.called]
            lost = bool(called)
            if not lost:
                bench.frames += bench.pipeline.feed(data, 0.0)
        bench.run(40)
        report = bench.pipeline.clocks
        assert report is not None and report.heard == 0 and not report.decorrelated


def test_silent_nodes_are_not_heard_and_the_reason_is_told() -> None:
    bench = Bench("sim://?scene=all&threshold=0&amplitude_mv=1&noise=0.02")
    bench.run(8)
    bench.call()
    bench.run(40)
    report = bench.pipeline.clocks
    assert report is not None and (report.heard, report.decorrelated, report.busy) == (
        0,
        False,
        False,
    )
    assert report.problem == "no node was heard alone in the roll call"


def test_a_refused_roll_call_is_told() -> None:
    bench = Bench("sim://?scene=all&threshold=0")
    bench.run(8)
    ack = Ack(PacketType.ROLL_CALL, 1, Result.UNSUPPORTED)
    bench.pipeline.feed(PacketWriter().encode(ack), 0.0)
    report = bench.pipeline.clocks
    assert report is not None and report.problem is not None and "refused" in report.problem


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"timing": "gap"}, "timing"),
        ({"samples_per_chip": 1}, "samples_per_chip"),
        ({"resync_chips": 32, "guard_chips": 1}, "resync_chips"),
    ],
)
def test_a_roll_call_that_cannot_work_is_refused(values: dict[str, Value], name: str) -> None:
    with pytest.raises(SpecError, match=f"roll_call.*{name}"):
        SkinConfig.of({"roll_call": True, **values})


def test_the_driver_calls_the_roll_once_the_gap_is_known_and_after_a_reset_again() -> None:
    config = SkinConfig.of({"roll_call": True})
    pipeline, session = Pipeline(config, background=False), Session(config)
    now_s = 0.0
    for _ in range(2):
        digitizer = VirtualDigitizer(SimOptions.from_url(f"sim://?speed=0{OWN}"), lambda: 0.0)
        digitizer.receive(session.open())
        called = []
        for _ in range(200):
            digitizer.advance(1)
            pipeline.feed(digitizer.take(digitizer.pending), now_s)
            request = session.watch(pipeline, now_s)
            called.append(bool(request))
            digitizer.receive(request)
            now_s += 6.4e-3
        assert sum(called) == 1 and called.index(True) > 1
        assert pipeline.clocks is not None and pipeline.clocks.decorrelated
        pipeline.reconnected()


def test_no_word_is_certain_before_the_clocks_are_known() -> None:
    bench = Bench("sim://?scene=all&threshold=0&heartbeat=0", roll_call=True)
    bench.run(8)
    assert all(frame.words.doubtful.all() for frame in bench.frames)
    bench.call()
    bench.run(40)
    assert not bench.frames[-1].words.doubtful.any()
