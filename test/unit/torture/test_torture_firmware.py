# SPDX-License-Identifier: Apache-2.0

"""The campaign on the firmware passes sound firmware and finds planted defects."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from test.support.waiting import PATIENCE_S
from torture.fuzz.both_languages import same_answers, same_samples
from torture.fuzz.harnesses import BUILD, FIRMWARE, SIMAVR, build
from torture.fuzz.sync_storms import NODE, SPEC, node_for, storms_at
from torture.outcome import COUNTS, Plan, bad

PLAN = Plan(quick=True, seed=1)
CORE = ("digitizer", "setup", "stream", "pull", "pulses", "packet", "cobs", "crc32")


@pytest.fixture(scope="module")
def needs_cc() -> None:
    if shutil.which("cc") is None:
        pytest.skip("no cc on this machine: the firmware's core is not compared with the simulator")


def test_both_languages_agree(needs_cc: None) -> None:
    build("replay-native")
    replay = BUILD / "replay" / "replay"
    for found in (same_answers(replay, PLAN), same_samples(replay, PLAN)):
        assert found.times > 100
        assert found.good


@pytest.mark.parametrize(
    ("file", "right", "wrong", "counts"),
    [
        ("digitizer.c", "reader->payload_size < commands[i].least_size || ", "", COUNTS[:1]),
        ("digitizer.c", "            dg->reader.errors++;", "            {}", COUNTS[1:2]),
        (
            "stream.c",
            "= counts[i] ^ TP_SAMPLE_XOR",
            "= (counts[i] & 0xFFEu) ^ TP_SAMPLE_XOR",
            COUNTS[:1],
        ),
        ("stream.c", "    stream->samples_lost += size;", "", COUNTS[1:2]),
    ],
)
def test_a_core_that_differs_is_found(
    needs_cc: None, tmp_path: Path, file: str, right: str, wrong: str, counts: tuple[str, ...]
) -> None:
    text = (FIRMWARE / "core" / file).read_text()
    assert text.count(right) == 1
    (tmp_path / file).write_text(text.replace(right, wrong))
    sources = [FIRMWARE / "core" / f"{name}.c" for name in CORE if f"{name}.c" != file]
    sources += [tmp_path / file, FIRMWARE / "digitizer" / "replay" / "replay.c"]
    program = tmp_path / "replay"
    command = ["cc", "-std=gnu99", "-I", FIRMWARE / "core", *sources, "-o", program]
    subprocess.run([str(part) for part in command], check=True, timeout=PATIENCE_S)
    compare = same_answers if file == "digitizer.c" else same_samples
    assert tuple(bad(compare(program, PLAN))) == counts


@pytest.mark.parametrize(
    ("number", "count"), [(NODE, []), (NODE + 1, ["wrong_values"]), (0, ["hangs"])]
)
def test_a_node_is_heard_out_after_storms(number: int, count: list[str]) -> None:
    """The right one; one that speaks in another's place; one without a memory, which is silent."""
    if shutil.which("avr-gcc") is None or not SIMAVR.exists():
        pytest.skip("no avr-gcc or no libsimavr-dev on this machine: no node is emulated")
    build("node")
    build("sim")
    node = node_for(SPEC, number) if number else replace(node_for(SPEC), memory=b"")
    found = storms_at(node, PLAN)
    assert found.times == 10
    assert bad(found) == count
