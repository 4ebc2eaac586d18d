# SPDX-License-Identifier: Apache-2.0

"""C under any input, the firmware's core and the driver's kernel.

Past finds stay fixed, and the harnesses detect planted faults.
"""

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from test.support.firmware import CORE, FIRMWARE, SANITIZE, STRICT, need, run
from torture.fuzz import corpus
from torture.fuzz.harnesses import BUILD, best_kind, build, fuzz, harnesses

SECONDS, HANG_S = 60, 30
MUTANTS = {"board": 20}
"""Of harnesses whose inputs take long: a whole board is emulated for each. Of others 200."""
OBJECTS = BUILD / "fuzz" / "standalone"
KERNEL = FIRMWARE.parent / "kernel"
WRONG, UNCOUNTED = "wrong value", "uncounted loss"


class Defect(NamedTuple):
    """What must be found (fault) by a harness when a file has `wrong` in place of `right`."""

    harness: str
    file: str
    fault: str
    right: str
    wrong: str

    @property
    def sources(self) -> Path:
        return KERNEL if self.harness in ("kernel", "stream") else CORE


DEFECTS = {
    "a field is read from the wrong place": Defect("framing", "packet.c", "crash",
        "reader->payload[place - sizeof reader->header] = byte",
        "reader->payload[place - 1] = byte"),
    "the end of a packet is off by one": Defect("framing", "packet.c", WRONG,
        "reader->payload_size = reader->raw - sizeof reader->header",
        "reader->payload_size = reader->raw"),
    "a wrong CRC is not counted": Defect("framing", "packet.c", UNCOUNTED,
        "        reader->errors++;\n        return false;",
        "        return false;"),
    "a loop without end": Defect("framing", "cobs.c", "hang",
        "            from++;\n",
        ""),
    "a chip's only sample drifts": Defect("setup", "setup.c", WRONG,
        " || (mean == 1 && chip_length(setup) % STRIDE_MILLI != 0)",
        ""),
    "chips are left out in pairs, of an odd row": Defect("node", "node_memory.c", WRONG,
        " && record->order % 2 == 0",
        ""),
    "chips too short to be flipped are": Defect("node", "node_memory.c", WRONG,
        "record->scramble ? limits->scrambled_chip_ns : limits->chip_ns",
        "limits->chip_ns"),
    "nobody packs": Defect("digitizer", "digitizer.c", WRONG,
        "dg->stream.packs = true",
        "dg->stream.packs = false"),
    "a new configuration packs": Defect("digitizer", "digitizer.c", WRONG,
        "    dg->stream.packs = false;\n",
        ""),
    "who is asked to speak is for ever": Defect("digitizer", "pulses.c", WRONG,
        "        pulses->words_left--;\n",
        ""),
    "a pulse is taken for a signal": Defect("digitizer", "pull.c", WRONG,
        "if (pull->position < pull->from) {",
        "if (pull->position < pull->to) {"),
    "hum is taken for a pulse": Defect("digitizer", "pull.c", UNCOUNTED,
        "step > pull->swing || step < -pull->swing",
        "step > 40 || step < -40"),
    "a butterfly subtracts the wrong way": Defect("kernel", "transform_lanes.h", WRONG,
        "x[i | half] = a - b",
        "x[i | half] = b - a"),
    "the last columns of a dense factor are left out": Defect("kernel", "transform.c", WRONG,
        "    to[(first + column) * order + i] = ",
        "    if (column + 1 < number) to[(first + column) * order + i] = "),
    "a block may end beyond its run": Defect("kernel", "scanner.c", "crash",
        "        if (length > size - in)\n            return SIZE_MAX;\n",
        ""),
    "the sums of the last nodes go to those before": Defect("kernel", "words.c", WRONG,
        "measure_eight(last, 8, bits, measures, whole, nodes - whole)",
        "measure_eight(last, 8, bits, measures, whole - !!whole, nodes - whole)"),
    "a contact ends where its first taxel's neighbours do": Defect("kernel", "contacts.c", WRONG,
        "waiting[left++] = near[n];",
        "(void)waiting;"),
    "a run that is too long is not counted": Defect("kernel", "scanner.c", UNCOUNTED,
        "        scanner->seen.resyncs++;\n",
        ""),
    "a mark within a frame begins another": Defect("stream", "frame_stream.c", WRONG,
        "        return decide(stream, stream->end, true);\n    const struct",
        "        stream->start = -1;\n    const struct"),
    "a packet that is off in time continues the stream": Defect("stream", "frame_stream.c", WRONG,
        "return least_s - slack_s <= ahead_s",
        "return least_s - 1e9 <= ahead_s"),
    "a packet follows while another one is held back": Defect("stream", "frame_stream.c", WRONG,
        "|| !stream->began || stream->holds ||",
        "|| !stream->began ||"),
    "a frame waits for one sample too many": Defect("stream", "frame_stream.c", UNCOUNTED,
        "bool is_due = stream->end >= stream->due;",
        "bool is_due = stream->end > stream->due;"),
    "the first samples of a long frame are forgotten": Defect("stream", "frame_stream.c", WRONG,
        "    if (stream->start < 0 && stream->rules.marked)\n",
        "    if (stream->rules.marked)\n"),
    "a frame that is cut off is not told": Defect("stream", "stream_state.c", UNCOUNTED,
        "if (anew && stream_reset(stream))",
        "if (anew && stream_reset(stream) && answer == STREAM_TAKE_HELD)"),
    "words are silence": Defect("stream", "frame_reader.c", WRONG,
        "if (power <= rules->silent_power) {",
        "if (power <= 17 * rules->silent_power) {"),
    "the bits of a frame are read in another order": Defect("stream", "words.c", WRONG,
        "signs = signs + signs - (value > 0)",
        "signs = signs - ((value > 0) << (int32_t)bit)"),
    "frames in doubt are certain": Defect("kernel", "frame_reader.c", WRONG,
        "if (!(certificate_worst(certificate) < 1))",
        "if (false)"),
    "what is behind an absurd sample is silence": Defect("kernel", "frame_reader.c", WRONG,
        "    if (isnan(power)) /* chips of",
        "    if (false) /* chips of"),
    "edges are sought where there are no pauses": Defect("kernel", "fit.c", WRONG,
        "levels[code->places[i] + 1] = model[i]",
        "levels[i + 1] = model[i]"),
}  # fmt: skip


@pytest.mark.slow
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


def planted(defect: Defect, folder: Path) -> Path:
    """A harness with a defect in one file of its sources; the others are as make built them."""
    build("fuzz-standalone")
    sources, file = defect.sources, defect.file
    text = (sources / file).read_text()
    assert text.count(defect.right) == 1
    changed = folder / file
    changed.write_text(text.replace(defect.right, defect.wrong))
    if changed.suffix == ".h":
        [user] = [path for path in sources.glob("*.c") if f'"{file}"' in path.read_text()]
        changed = Path(shutil.copy(user, folder))
    include = ("-I", sources, "-I", FIRMWARE / "fuzz")
    run(need("cc"), *STRICT, *include, *SANITIZE, "-c", changed, cwd=folder)
    objects = [path for path in OBJECTS.glob("fuzz/*.o") if not path.stem.startswith("fuzz_")]
    objects += [OBJECTS / "fuzz" / f"fuzz_{defect.harness}.o", *OBJECTS.glob("core/*.o")]
    if sources == KERNEL:  # of files that are gone objects may be left
        objects += [OBJECTS / "kernel_sources" / f"{path.stem}.o" for path in KERNEL.glob("*.c")]
    objects = [path for path in objects if path.stem != changed.stem]
    program = folder / defect.harness
    run(need("cc"), *SANITIZE, folder / f"{changed.stem}.o", *objects, "-lm", "-o", program)
    return program


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_found(name: str, tmp_path: Path) -> None:
    defect = DEFECTS[name]
    limits = (20_000, 1, 20, 10) if defect.sources == KERNEL else (3000, 1, 3, 2)
    found = fuzz(planted(defect, tmp_path), "standalone", *limits)
    assert found.fault == defect.fault, found.said
