# SPDX-License-Identifier: Apache-2.0

"""C under any input, the firmware's core and the driver's kernel.

Past finds stay fixed, and the harnesses detect planted faults.
"""

import shutil
from pathlib import Path

import pytest

from test.support.firmware import CORE, FIRMWARE, SANITIZE, STRICT, need, run
from torture.fuzz import corpus
from torture.fuzz.harnesses import BUILD, best_kind, build, fuzz, harnesses

SECONDS, HANG_S = 60, 30
MUTANTS = {"board": 20}
"""Of harnesses whose inputs take long: a whole board is emulated for each. Of others 200."""
OBJECTS = BUILD / "fuzz" / "standalone"
KERNEL = FIRMWARE.parent / "kernel"
DEFECTS = {  # harness, file; what is there; what is there instead; what must be found
    "a field is read from the wrong place": (
        "framing",
        "packet.c",
        "reader->payload[place - sizeof reader->header] = byte",
        "reader->payload[place - 1] = byte",
        "crash",
    ),
    "the end of a packet is off by one": (
        "framing",
        "packet.c",
        "reader->payload_size = reader->raw - sizeof reader->header",
        "reader->payload_size = reader->raw",
        "wrong value",
    ),
    "a wrong CRC is not counted": (
        "framing",
        "packet.c",
        "        reader->errors++;\n        return false;",
        "        return false;",
        "uncounted loss",
    ),
    "a loop without end": ("framing", "cobs.c", "            from++;\n", "", "hang"),
    "a chip's only sample drifts": (
        "setup",
        "setup.c",
        " || (mean == 1 && chip_length(setup) % STRIDE_MILLI != 0)",
        "",
        "wrong value",
    ),
    "chips are left out in pairs, of an odd row": (
        "node",
        "node_memory.c",
        " && record->order % 2 == 0",
        "",
        "wrong value",
    ),
    "chips too short to be flipped are": (
        "node",
        "node_memory.c",
        "record->scramble ? limits->scrambled_chip_ns : limits->chip_ns",
        "limits->chip_ns",
        "wrong value",
    ),
    "nobody packs": (
        "digitizer",
        "digitizer.c",
        "dg->stream.packs = true",
        "dg->stream.packs = false",
        "wrong value",
    ),
    "a new configuration packs": (
        "digitizer",
        "digitizer.c",
        "    dg->stream.packs = false;\n",
        "",
        "wrong value",
    ),
}


@pytest.mark.parametrize("name", harnesses())
def test_kept_cases_and_mutants_of_them(name: str) -> None:
    """By any compiler, so that it works without clang."""
    need("cc")
    build("fuzz-standalone")
    program, count = BUILD / "fuzz" / "standalone" / name, MUTANTS.get(name, 200)
    found = fuzz(program, "standalone", count, 1, SECONDS, HANG_S)
    assert (found.fault, found.said) == ("", "")
    assert found.inputs == count + len(corpus.read(f"firmware_{name}")) > count


@pytest.mark.parametrize("name", harnesses())
def test_a_slice_of_what_libfuzzer_tries(name: str) -> None:
    if best_kind() != "libfuzzer":
        pytest.skip("no libFuzzer on this machine: the core is not fuzzed with it")
    build("fuzz-libfuzzer")
    found = fuzz(BUILD / "fuzz" / "libfuzzer" / name, "libfuzzer", 500, 1, SECONDS, HANG_S)
    assert (found.fault, found.said) == ("", "")
    assert found.inputs > 0


def planted(name: str, sources: Path, defect: tuple[str, str, str], folder: Path) -> Path:
    """A harness with a defect in one file of some sources; the others are as make built them."""
    build("fuzz-standalone")
    file, right, wrong = defect
    text = (sources / file).read_text()
    assert text.count(right) == 1
    changed = folder / file
    changed.write_text(text.replace(right, wrong))
    if changed.suffix == ".h":
        [user] = [path for path in sources.glob("*.c") if f'"{file}"' in path.read_text()]
        changed = Path(shutil.copy(user, folder))
    include = ("-I", sources, "-I", FIRMWARE / "fuzz")
    run(need("cc"), *STRICT, *include, *SANITIZE, "-c", changed, cwd=folder)
    objects = [path for path in OBJECTS.glob("fuzz/*.o") if not path.stem.startswith("fuzz_")]
    objects += [OBJECTS / "fuzz" / f"fuzz_{name}.o", *OBJECTS.glob("core/*.o")]
    objects += OBJECTS.glob("kernel_sources/*.o") if sources == KERNEL else ()
    objects = [path for path in objects if path.stem != changed.stem]
    program = folder / name
    run(need("cc"), *SANITIZE, folder / f"{changed.stem}.o", *objects, "-lm", "-o", program)
    return program


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_planted_defect_is_found(defect: str, tmp_path: Path) -> None:
    name, *change, fault = DEFECTS[defect]
    program = planted(name, CORE, (change[0], change[1], change[2]), tmp_path)
    found = fuzz(program, "standalone", 3000, 1, 3, 2)
    assert found.fault == fault, found.said


KERNEL_DEFECTS = {
    "a butterfly subtracts the wrong way": (
        "transform_lanes.h",
        "x[i | half] = a - b",
        "x[i | half] = b - a",
        "wrong value",
    ),
    "the last columns of a dense factor are left out": (
        "transform.c",
        "    to[(first + column) * order + i] = ",
        "    if (column + 1 < number) to[(first + column) * order + i] = ",
        "wrong value",
    ),
    "a block may end beyond its run": (
        "scanner.c",
        "        if (length > size - in)\n            return SIZE_MAX;\n",
        "",
        "crash",
    ),
    "the sum of a block of nodes goes to the one before": (
        "words.c",
        "measure_block(levels + first, step, bits, nodes - first, measures, first)",
        "measure_block(levels + first, step, bits, nodes - first, measures, first - 1 + !first)",
        "wrong value",
    ),
    "a contact ends where its first taxel's neighbours do": (
        "contacts.c",
        "waiting[left++] = near[n];",
        "(void)waiting;",
        "wrong value",
    ),
    "a run that is too long is not counted": (
        "scanner.c",
        "    if (size > MAX_RUN - before) {\n        scanner->seen.resyncs++;",
        "    if (size > MAX_RUN - before) {",
        "uncounted loss",
    ),
}


STREAM_DEFECTS = {
    "a mark within a frame begins another": (
        "frame_stream.c",
        "        return decide(stream, stream->end, true);\n    if (stream->gap_begin",
        "        stream->start = -1;\n    if (stream->gap_begin",
        "wrong value",
    ),
    "a packet that is off in time continues the stream": (
        "frame_stream.c",
        "return least_s - slack_s <= ahead_s",
        "return least_s - 1e9 <= ahead_s",
        "wrong value",
    ),
    "a packet follows while another one is held back": (
        "frame_stream.c",
        "|| !stream->began || stream->holds ||",
        "|| !stream->began ||",
        "wrong value",
    ),
    "a frame waits for one sample too many": (
        "frame_stream.c",
        "bool is_due = stream->end >= stream->due;",
        "bool is_due = stream->end > stream->due;",
        "uncounted loss",
    ),
    "the first samples of a long frame are forgotten": (
        "frame_stream.c",
        "    if (stream->start < 0 && stream->rules.marked)\n",
        "    if (stream->rules.marked)\n",
        "wrong value",
    ),
    "a frame that is cut off is not told": (
        "frame_stream.c",
        "*cut_short = reset(stream);",
        "*cut_short = reset(stream) && answer == STREAM_TAKE_HELD;",
        "uncounted loss",
    ),
    "words are silence": (
        "marked_frame.c",
        "if (power <= rules->silent_power + ",
        "if (power <= 17 * rules->silent_power + ",
        "wrong value",
    ),
}


@pytest.mark.parametrize("defect", KERNEL_DEFECTS | STREAM_DEFECTS)
def test_a_defect_planted_in_the_kernel_is_found(defect: str, tmp_path: Path) -> None:
    name = "stream" if defect in STREAM_DEFECTS else "kernel"
    *change, fault = (KERNEL_DEFECTS | STREAM_DEFECTS)[defect]
    program = planted(name, KERNEL, (change[0], change[1], change[2]), tmp_path)
    found = fuzz(program, "standalone", 20_000, 1, 20, 10)
    assert found.fault == fault, found.said
