# SPDX-License-Identifier: Apache-2.0

"""Nodes that scramble otherwise than the parameters say are named, by driver and doctor."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from tactile_cdma.config.parameters import Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.doctor.port import examine
from tactile_cdma.driver import checkup
from tactile_cdma.driver.checkup import Level
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.scrambling import ScrambleWatch, mismatch
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.protocol_sim import Serial
from test.support.simulated import OtherwiseScrambled, told
from test.support.waiting import wait_for

SCRAMBLED = "the nodes scramble their chips, but scramble is false: set scramble to true"
PLAIN = "the nodes do not scramble their chips, but scramble is true: write their memories anew"
SAID = pytest.mark.parametrize(("scramble", "said"), [(False, SCRAMBLED), (True, PLAIN)])
"""By the parameter, of which nodes do the opposite."""
THOUSAND: dict[str, Value] = {
    "nodes": 900,
    "order": 912,
    "chip_us": 2.0,
    "frame_period_ms": 19.96,
    "samples_per_chip": 1,
    "resync_chips": 912,
    "guard_chips": 40,
}
SKINS: list[tuple[str, dict[str, Value]]] = [
    ("scene=all&threshold=0", {}),
    ("scene=press", {}),
    ("scene=idle", {}),
    ("scene=idle", {"nodes": 1, "order": 20}),
    ("scene=press", {"nodes": 2, "order": 4}),
    ("scene=press", {"nodes": 64, "frame_period_ms": 40.0, "samples_per_chip": 1}),
    ("scene=all&threshold=0", THOUSAND),
    ("scene=press", {"timing": "gap"}),
    ("scene=press&amplitude_mv=150", {}),
]
"""Many speakers, few, and one a second; one value per chip; another amplitude than is stated."""


def chunks_of(
    kind: type[VirtualDigitizer], config: SkinConfig, options: str, seconds: float
) -> Iterator[tuple[bytes, float]]:
    """What a host reads of a digitizer that it sets up by these parameters, and when."""
    return told(SimOptions.from_url(f"sim://?{options}"), seconds, config, kind)


@SAID
@pytest.mark.parametrize(("options", "values"), SKINS)
def test_the_other_way_is_found(
    options: str, values: dict[str, Value], scramble: bool, said: str
) -> None:
    config = SkinConfig.of({**values, "scramble": scramble})
    found = mismatch(config, chunks_of(OtherwiseScrambled, config, options, 5.0))
    assert found is not None and found.startswith(said)


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize(("options", "values"), SKINS)
def test_nodes_that_do_as_the_parameters_say_are_not_accused(
    options: str, values: dict[str, Value], scramble: bool
) -> None:
    config = SkinConfig.of({**values, "scramble": scramble})
    chunks = [*chunks_of(VirtualDigitizer, config, options, 3.0)]
    assert mismatch(config, chunks) is None
    pipeline, watch = Pipeline(config), ScrambleWatch(config)
    for data, t_host in chunks:
        for frame in pipeline.feed(data, t_host):
            watch.hear(frame)
        assert not watch.look(pipeline) and not watch.listens
    assert watch.is_over


@pytest.mark.parametrize("scramble", [False, True])
@pytest.mark.parametrize(
    ("options", "values"),
    [
        ("scene=idle&heartbeat=0&noise=0.1", {}),  # nobody speaks
        ("scene=all&threshold=0&noise=3", {}),  # nobody is heard
        ("scene=all&threshold=0", {"drive": "unipolar"}),
        ("scene=press", {"nodes": 9, "order": 16, "codes": "sparse", "samples_per_chip": 1}),
    ],
)
def test_what_has_no_words_either_way_is_no_mismatch(
    options: str, values: dict[str, Value], scramble: bool
) -> None:
    given = {**values, "scramble": scramble and "drive" not in values}
    config = SkinConfig.of(given)
    assert mismatch(config, chunks_of(VirtualDigitizer, config, options, 3.0)) is None


@pytest.fixture
def otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes behind sim:// scramble if the driver does not, and the reverse."""

    def made(self: Serial, url: str) -> VirtualDigitizer:
        return OtherwiseScrambled(SimOptions.from_url(url, self.layout))

    monkeypatch.setattr(Serial, "_made", made)


@SAID
@pytest.mark.parametrize("scene", ["all&threshold=0", "press"])
def test_the_driver_tells(
    otherwise: None, caplog: pytest.LogCaptureFixture, scene: str, scramble: bool, said: str
) -> None:
    """In the log, in /diagnostics, and as the problem where there is no frame at all."""
    frames: list[TactileFrame] = []
    problems: list[str | None] = []
    config = SkinConfig.of({"scramble": scramble})
    with (
        caplog.at_level(logging.ERROR),
        Driver(config, f"sim://?scene={scene}", 9600, frames.append, problems.append) as driver,
    ):
        wait_for(lambda: driver.scrambling.problem)
        told = driver.scrambling.problem
        with driver.between_frames() as pipeline:
            window = driver.vitals.take(pipeline)
            [finding] = checkup.nodes(pipeline, [], window, driver.scrambling.problem)
        if not frames:
            wait_for(lambda: any(said in (problem or "") for problem in problems))
    assert (finding.text, finding.level) == (told, Level.ERROR)
    assert said in finding.text and said in caplog.text
    assert caplog.text.count(said) == 1
    assert not any((frame.words.active & ~frame.words.doubtful).any() for frame in frames)


@SAID
@pytest.mark.parametrize("scene", ["all&threshold=0", "press"])
def test_the_doctor_tells(
    otherwise: None, tmp_path: Path, scene: str, scramble: bool, said: str
) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text(f"/**: {{ros__parameters: {{scramble: {str(scramble).lower()}}}}}")
    found = [*examine(f"sim://?scene={scene}", params, None, 2.0)]
    [wrong] = [check for check in found if check.verdict == "problem"]
    assert wrong.subject == "scramble" and wrong.text.startswith(said)


def test_it_listens_again_later_and_ever_more_seldom() -> None:
    """A line of noise costs a look, and then another after ten times as many frames."""
    config = SkinConfig.of({"samples_per_chip": 1})
    pipeline, watch, began = Pipeline(config), ScrambleWatch(config), []
    options = "scene=all&threshold=0&noise=1"
    for data, t_host in chunks_of(VirtualDigitizer, config, options, 20.0):
        listened = watch.listens
        if listened:
            watch.note(data, t_host)
        for frame in pipeline.feed(data, t_host):
            watch.hear(frame)
        assert not watch.look(pipeline)
        if watch.listens and not listened:
            began.append(t_host)
    assert len(began) == 2 and began[1] > 5 * began[0]
