# SPDX-License-Identifier: Apache-2.0

"""A rate that one asks for: chips that nodes can make, or the fastest rate by name."""

import logging
import re

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.config.frame_rate import MCU_OF
from tactile_cdma.config.parameters import ANY, FOUR, KINDS, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.session import Session
from tactile_cdma.hardware.node_memory import node_memory, read_node_memory
from tactile_cdma.recording.offline import parameters_of
from tactile_cdma.wire.messages import FrameLayout, Info
from tactile_cdma.wire.packets import PacketParser
from test.support.examples import examples
from test.support.simulated import stream


@given(
    nodes=st.integers(1, 1200),
    rate_hz=st.floats(0.5, 400),
    kind=st.sampled_from([ANY, *KINDS, FOUR]),
    scramble=st.booleans(),
    parity=st.booleans(),
)
@examples(80)
def test_nodes_of_the_kind_take_what_is_chosen_and_it_has_the_rate(
    nodes: int, rate_hz: float, kind: str, scramble: bool, parity: bool
) -> None:
    """Each memory's own checks, which know nothing of rates, are the judge; or the refusal is."""
    assume(nodes > 2)  # scrambled codes are longer
    asked = {"nodes": nodes, "node_kind": kind, "scramble": scramble, "parity": parity}
    try:
        config = SkinConfig.of({**asked, "rate_hz": rate_hz})  # type: ignore[dict-item]
    except SpecError as error:
        assert str(error).startswith(f"rate_hz is {rate_hz:g}: no ")
        if found := re.search(r"faster than ([\d.]+) Hz", str(error)):
            fastest_hz = float(found[1])
            assert fastest_hz <= rate_hz
            if fastest_hz:
                SkinConfig.of({**asked, "rate_hz": fastest_hz})  # type: ignore[dict-item]
        else:
            assert kind in ("tiny", FOUR) and nodes >= 1000  # its memory holds no longer row
        return
    period_s = config.spec.frame_period_s
    assert 1 / rate_hz - 1e-6 <= period_s <= 1 / rate_hz
    assert config.node_kind == kind or kind == ANY
    memory = node_memory(config.spec, nodes, mcu=MCU_OF[config.node_kind], heartbeat=1)
    record, _ = read_node_memory(memory)
    assert record.frame_period_us == round(period_s * 1e6)
    assert record.chip_ns >= 2000  # a converter of 500 kS/s


def test_tiny_nodes_on_the_data_wire_have_an_image_of_their_own() -> None:
    asked: dict[str, Value] = {"nodes": 4, "rate_hz": 40.0, "node_kind": "tiny"}
    for wire, image in (("own", "attiny85"), ("data", "attiny85-data")):
        choice = SkinConfig.of({**asked, "sync_wire": wire}).choice
        assert choice.endswith(f"({image})")


@pytest.mark.parametrize(
    ("values", "chip_us", "kind"),
    [
        ({"nodes": 16}, 50.0, "slow"),
        ({"nodes": 40}, 43.1, "slow"),
        ({"nodes": 16, "node_kind": "fast"}, 16.0, "fast"),
        ({"nodes": 36, "node_kind": "four"}, 45.5, "four"),
        ({"nodes": 900, "scramble": True}, 2.0, "fast"),
    ],
)
def test_host_digitizer_and_recording_agree_on_what_was_chosen(
    values: dict[str, object], chip_us: float, kind: str
) -> None:
    """The simulated digitizer is set to it, describes it, and its frames are read at that rate."""
    config = SkinConfig.of({**values, "rate_hz": 50.0})  # type: ignore[dict-item]
    assert config.spec.chip_s * 1e6 == pytest.approx(chip_us)
    assert f"rate_hz 50: chip_us {chip_us}, frame_period_ms 20.0" in config.choice
    assert "write these anew" not in config.choice and config.node_kind == kind
    pipeline = Pipeline(config)
    data = stream(config, "sim://?scene=all&threshold=0", 5)
    frames = pipeline.feed(data, 0.0)
    assert len(frames) >= 4 and all(frame.words.active.all() for frame in frames)
    times_s = [frame.t_middle for frame in frames]
    assert times_s[-1] - times_s[0] == pytest.approx(0.02 * (len(frames) - 1), rel=1e-3)
    [*_, info] = [p for p in PacketParser().feed(data) if isinstance(p, Info)]
    described = SkinConfig.of({**values, "rate_hz": 77.0, **parameters_of(info)})  # type: ignore[dict-item]
    layouts = [FrameLayout.of(each.spec, each.samples_per_chip) for each in (described, config)]
    assert layouts[0] == layouts[1]
    Session(config)


def test_on_hardware_it_says_what_to_write_anew() -> None:
    said = SkinConfig.of({"rate_hz": 100.0, "port": "/dev/ttyACM0"}).choice
    assert "nodes with other records: write these anew (tactile-cdma node --all)" in said


def test_a_frame_of_half_a_second_is_warned_of_and_what_would_be_50_hz(
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = SkinConfig.of({"nodes": 900})
    [text] = [r.message for r in caplog.records if r.levelno == logging.WARNING]
    named = float(text.split("chip_us ")[1].split()[0])
    assert config.spec.frame_s > 0.4
    faster = SkinConfig.of({"nodes": 900, "chip_us": named, "frame_period_ms": 0.0})
    assert 0.0199 < faster.spec.frame_period_s <= 0.02
    caplog.clear()
    SkinConfig.of({"nodes": 90})
    SkinConfig.of({"nodes": 900, "rate_hz": 2.0})
    assert not [r for r in caplog.records if r.levelno == logging.WARNING]


def test_chips_of_the_parameter_count_unless_a_rate_is_asked_for() -> None:
    assert SkinConfig.of({"chip_us": 37.0}).spec.chip_s == pytest.approx(37e-6)
    for wrong in ({"rate_hz": -1.0}, {"node_kind": "huge"}):
        with pytest.raises(Exception, match="must"):
            SkinConfig.of(wrong)  # type: ignore[arg-type]
    with pytest.raises(
        SpecError, match=r"no slow node .* faster than 3\.1 Hz, with chips of 35 µs"
    ):
        SkinConfig.of({"nodes": 900, "rate_hz": 50.0, "node_kind": "slow"})
