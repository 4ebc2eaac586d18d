# SPDX-License-Identifier: Apache-2.0

"""The simulator's URL: accepted and refused options, and how CONFIGURE changes them."""

import re
from pathlib import Path

import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.sim.nodes import NodeRules
from tactile_cdma.sim.options import OPTIONS, Setup, SimOptions
from tactile_cdma.sim.scene import EXTERNAL, LOADS, SCENES
from tactile_cdma.sim.sensor import SensorModel
from tactile_cdma.wire._protocol import SyncMode, SyncWire
from tactile_cdma.wire.messages import FrameLayout


def test_without_options_the_host_decides_the_layout() -> None:
    asked = Setup(FrameSpec(nodes=64, chip_s=10e-6), 8, SyncMode.HEAR)
    assert SimOptions.from_url("sim://").setup(asked) == asked
    assert SimOptions.from_url("sim://?noise=0.1&scene=hand").setup(asked) == asked


def test_every_option_can_be_given() -> None:
    url = (
        "sim://?nodes=12&scene=press&noise=0.01&seed=7&stretch=0.1&drive=unipolar&bits=12&order=16"
        "&chip_us=20&frame_period_ms=10&first_row=2&sign_seed=natural&polarity=-1&amplitude_mv=100"
        "&samples_per_chip=8&timing=line&integrated=0&offset=-0.2&jitter=0.05&threshold=3"
        "&heartbeat=10&speed=0&adc_bits=10&rail=2.5&rows=3&columns=4&pitch_mm=5&start_phase=0.5"
        "&parity=1&resync_chips=32&guard_chips=1&scramble=0&codes=orthogonal"
        "&clock_spread=0.01&delay_spread=0.5"
        "&sensor=paper&hysteresis=2&mismatch=0.05&warming=20&sensor_noise=0.002&dead=3,12&stuck=5"
        "&dead_after=2.5&layout=&calibration=&speaks=rest&sync_wire=data"
    )
    options = SimOptions.from_url(url)
    setup = options.setup()
    assert setup.spec == FrameSpec(
        nodes=12,
        bits=12,
        order=16,
        chip_s=20e-6,
        frame_period_s=10e-3,
        first_row=2,
        sign_seed=None,
        drive="unipolar",
        polarity=-1,
        amplitude_v=0.1,
        parity=True,
        resync_chips=32,
        guard_chips=1,
    )
    assert (setup.samples_per_chip, setup.sync, setup.integrated) == (8, SyncMode.DRIVE, False)
    assert setup.wire == SyncWire.DATA
    assert options.rules(setup.spec) == NodeRules(threshold=3, heartbeat=10, follow=1500)
    assert options.sensors == SensorModel(
        kind="paper",
        hysteresis=2.0,
        mismatch=0.05,
        warming_v=0.02,
        noise_v=0.002,
        dead=(3, 12),
        dead_after_s=2.5,
        stuck=(5,),
        seed=7,
    )
    assert url.count("=") == len(OPTIONS)


def test_the_page_has_every_option_and_scene() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "simulation.md").read_text()
    section = page[page.index("## Options") :].split("\n## ")[0]
    told = set(re.findall(r"`(\w+)(?:=[\w,]+)?`", section))
    assert told == {*(option.name for option in OPTIONS), *SCENES, *LOADS, EXTERNAL}


def test_pinned_options_win_and_the_rest_follows() -> None:
    asked = Setup(FrameSpec(nodes=16, bits=12, chip_s=25e-6), 6)
    setup = SimOptions(nodes=9, drive="unipolar").setup(asked)
    assert (setup.spec.nodes, setup.spec.drive) == (9, "unipolar")
    assert (setup.spec.bits, setup.spec.chip_s, setup.samples_per_chip) == (12, 25e-6, 6)


def test_what_is_pinned_makes_room_for_itself() -> None:
    spec = SimOptions(nodes=256).setup(Setup(FrameSpec(nodes=16))).spec
    assert spec.order >= 257
    assert spec.frame_s < spec.frame_period_s
    FrameLayout.of(spec, 4)  # the wire can say so


def test_pinned_sampling_wins() -> None:
    integrated = Setup(integrated=True)
    assert SimOptions(timing="gap").setup(integrated) == Setup(sync=SyncMode.NONE)
    blind = Setup(sync=SyncMode.NONE)
    assert SimOptions(integrated=True).setup(blind) == integrated


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("scene=pres", ["scene", "'pres'", "idle, press, presses", "did you mean 'press'"]),
        ("noize=1", ["'noize'", "did you mean 'noise'"]),
        ("qqq=1", ["'qqq'", "options: scene, nodes"]),
        ("stretch=0.5", ["stretch is 0.5", "0…0.11"]),
        ("nodes=many", ["nodes is 'many'", "an integer"]),
        ("noise=", ["noise is ''", "a number"]),
        ("noise=nan", ["noise", "0…100 V"]),
        ("integrated=maybe", ["integrated is 'maybe'", "0 or 1"]),
        (f"seed={'9' * 400}", ["seed is an integer of 1329 bits"]),
        (f"noise={'9' * 400}", ["noise is inf V", "0…100 V"]),
        (f"seed={'9' * 5000}", ["seed is '999", "an integer"]),
        (f"dead={'9' * 400}", ["dead is an integer of 1329 bits"]),
        ("polarity=0", ["polarity is 0", "1, -1"]),
        ("seed=1&seed=2", ["'seed'", "twice"]),
        ("integrated=1&timing=gap", ["integrated", "timing 'gap'"]),
        ("rows=3", ["3 rows", "16 nodes"]),
        ("order=18", ["18", "16 and 20"]),
        ("nodes=64&frame_period_ms=12.8", ["12.8 ms"]),
        ("stretch=0.1&chip_us=60&frame_period_ms=12.8", ["stretched by 0.1", "12.8 ms"]),
        ("first_row=0&drive=unipolar", ["row 0"]),
        ("sensor=papr", ["'papr'", "ideal, paper", "did you mean 'paper'"]),
        ("mismatch=0.2", ["mismatch is 0.2", "0…0.1"]),
        ("dead=3;4", ["dead is '3;4'", "commas"]),
        ("stuck=0", ["stuck is 0", "1…65535"]),
        ("nodes=16&dead=3,17", ["dead is 17", "1…16"]),
        ("chip_us=0.01&frame_period_ms=100", ["40000000 samples", "samples_per_chip"]),
        ("nodes=65535&clock_spread=0.001&chip_us=0.01", ["65535 nodes", "clock_spread"]),
        (
            "layout=~nobody-of-that-name/skin.yaml",
            ["layout is ~nobody-of-that-name/", "the user after ~ has no home"],
        ),
    ],
)
def test_bad_options_are_refused_by_name(query: str, words: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        SimOptions.from_url(f"sim://?{query}")
    for word in words:
        assert word in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("url", ["sim://host", "loop://", "sim:///path?seed=1", "sim://?a=1#b"])
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(SpecError):
        SimOptions.from_url(url)
