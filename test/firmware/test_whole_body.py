# SPDX-License-Identifier: Apache-2.0

"""`make firmware-body`: frames of Picos that hear one begin together; it must be able to fail."""

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import parts_list
import whole_body
from emulated import EmulationError
from tactile_cdma.config.body_file import Patch, read_body
from tactile_cdma.config.frame_rate import MCU_OF, MCUS, frames_of
from tactile_cdma.config.parameters import DRIVES, Value
from tactile_cdma.config.skin_config import SkinConfig
from test.support.firmware import FIRMWARE
from whole_body import BODY, MOST_SKEW_US, compare, drive, emulate_all

pytestmark = pytest.mark.usefixtures("node_images", "rp2040_image")
FRAMES = 8
FEW: dict[str, Value] = {"nodes": 6, "rows": 2, "columns": 3, "layout_file": ""}
SLOW: dict[str, Value] = {"node_kind": "slow", "samples_per_chip": 4}


def two(both: Mapping[str, Value] = FEW, **changes: Value) -> list[Patch]:
    """The patch that drives and another one. both: changes of their values, changes: of its own."""
    by_name = {patch.name: patch for patch in read_body(BODY).patches}
    found = by_name["belly"], by_name["left_shin"]
    few = [replace(patch, values={**patch.values, **FEW, **both}) for patch in found]
    return [few[0], replace(few[1], values={**few[1].values, **changes})]


@pytest.mark.slow
@pytest.mark.parametrize("both", [FEW, SLOW], ids=["fast nodes, means", "slow nodes, raw samples"])
def test_two_patches_begin_their_frames_together_and_no_word_is_wrong(
    tmp_path: Path, both: Mapping[str, Value]
) -> None:
    emulated = emulate_all(two(both), FRAMES, 3, tmp_path, None)
    heard = drive(tmp_path, emulated)
    found = compare(emulated, heard)
    assert (found.nodes, found.wrong, found.lost_samples) == (12, 0, 0)
    assert found.frames >= FRAMES - 3
    sample_us = 2.0 if both is FEW else 12.5
    assert found.skew_us < 2 * sample_us + 1, "of a patch's samples, and of the time's unit"
    codes = np.array([frame.codes for frame in heard["belly"][-FRAMES:]])
    assert np.unique(codes).size > 20, "nodes say all kinds of words"
    others = [replace(patch, truth=np.roll(patch.truth, 1, axis=0)) for patch in emulated]
    assert compare(others, heard).wrong > 50, "other words are counted"
    late = [
        emulated[0],
        replace(emulated[1], marks_ns=[t + 6_000_000 for t in emulated[1].marks_ns]),
    ]
    assert compare(late, heard).wrong >= emulated[1].truth.size, "frames that are missing, too"


@pytest.mark.slow
def test_without_the_wire_frames_begin_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole_body.Rp2040Skin, "hear", lambda *_: None)
    emulated = emulate_all(two(), FRAMES, 3, tmp_path, None)
    found = compare(emulated, drive(tmp_path, emulated))
    assert (found.wrong, found.lost_samples) == (0, 0), "each patch for itself is well"
    assert found.skew_us > MOST_SKEW_US


def test_a_body_has_one_clock(tmp_path: Path) -> None:
    with pytest.raises(EmulationError, match="2 patches drive"):
        emulate_all(two(sync=DRIVES), FRAMES, 1, tmp_path, None)


SPLITS = ((72, 13, "fast"), (48, 20, "slow"), (64, 15, "slow"), (32, 30, "four"))
"""Taxels of a Pico, Picos, kind of nodes."""


def splits() -> Iterator[list[str]]:
    """Rows of the page's table: one Pico's nodes, chips, times, and costs by the parts list."""
    kicad = FIRMWARE / "boards" / "kicad"
    parts = parts_list.read_parts(kicad)

    def cost(board: str, nodes: int) -> float:
        return sum(parts_list.bought(part, nodes).cost for part in parts[board])

    lines = csv.DictReader(io.StringIO(parts_list.csv_text(parts)))
    usd = {line["number"]: float(line["usd_each"]) for line in lines}
    faster = usd["TLV3541IDBVR"] - usd["OPA365AIDBVR"]
    for nodes, picos, kind in SPLITS:
        spec = SkinConfig.of({"nodes": nodes, "scramble": True, "frame_period_ms": 0.0}).spec
        able = [*frames_of(spec, kind)]
        made = next((frames for frames in able if frames.room_s <= 0.02), able[-1])
        is_fast = kind == "fast"
        suffix, of = "" if kind == "slow" else f"-{kind}", 900 if is_fast else 64
        node, strips = cost(f"node{suffix}", of), -(-nodes // 8) * cost(f"strip{suffix}", of)
        chips = nodes / MCUS[MCU_OF[kind]].sensors
        pico = chips * node + strips + cost("digitizer", 64) + faster * is_fast
        yield [
            *(str(nodes), str(picos), f"{kind}, {made.spec.chip_s * 1e6:g} µs"),
            f"{made.spec.frame_s * 1e3:.1f} ms, {made.room_s * 1e3:.1f} ms",
            *(f"{picos * pico:,.0f}", f"{pico / nodes:.2f}"),
        ]


def test_the_page_says_what_divisions_take_and_cost() -> None:
    page = (FIRMWARE / "README.md").read_text(encoding="utf-8")
    table = page.split("<!-- splits: test_whole_body.py computes them -->")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.split("\n")[3:]]
    assert rows == [*splits()]


def test_the_body_has_900_taxels_in_20_ms_on_boards_of_their_own() -> None:
    patches = read_body(BODY).patches
    configs = [SkinConfig.of(patch.values) for patch in patches]
    assert len(patches) == 13 and sum(config.spec.nodes for config in configs) == 936
    assert {config.spec.frame_period_s for config in configs} == {0.02}
    assert {len(config.layout.nodes) for config in configs} == {72}
    assert [config.sync for config in configs].count(DRIVES) == 1
    assert len({patch.values["port"] for patch in patches}) == 13
