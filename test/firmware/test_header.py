# SPDX-License-Identifier: Apache-2.0

"""The generated C header: it compiles, its sizes hold, and its structs give the shared vectors."""

import json
from pathlib import Path
from typing import Any

import pytest

from tactile_cdma.wire._protocol import (
    FLAG_CALLED,
    FLAG_OVERRUN,
    FLAG_SYNC,
    TURN_SHIFT,
    PacketType,
)
from tactile_cdma.wire.packets import MAX_PACKET
from test.support.firmware import CORE, FIRMWARE, need, run
from test.support.programs import run_program

VECTORS = json.loads((FIRMWARE / "vectors" / "protocol.json").read_text())["packets"]
STRICT = ("-Wall", "-Wextra", "-Werror", "-I", str(CORE))


@pytest.mark.parametrize(
    ("name", "standard"),
    [
        ("cc", "c11"),
        ("cc", "gnu99"),
        ("clang", "c11"),
        ("avr-gcc", "gnu99"),
        ("arm-none-eabi-gcc", "c11"),
    ],
)
def test_header_compiles_by_itself_and_its_assertions_hold(
    name: str, standard: str, tmp_path: Path
) -> None:
    source = tmp_path / "header.c"
    source.write_text(
        '#include "tactile_protocol.h"\n'
        f'_Static_assert(TP_MAX_PACKET == {MAX_PACKET}, "as in Python");\n'
        '_Static_assert(sizeof(struct tp_info) == 65, "as in docs/protocol.md");\n'
        "int unit;\n"
    )
    run(need(name), f"-std={standard}", *STRICT, "-fsyntax-only", source)


def test_an_assertion_would_fail(tmp_path: Path) -> None:
    source = tmp_path / "header.c"
    source.write_text('#include "tactile_protocol.h"\nTP_ASSERT_AT(tp_info, frame, 32);\n')
    result = run_program(need("cc"), "-std=c11", *STRICT, "-fsyntax-only", source)
    assert result.returncode != 0
    assert "tp_info.frame" in result.stderr


def test_structs_give_the_vectors(tmp_path: Path) -> None:
    cc = need("cc")
    (tmp_path / "vectors.inc").write_text("".join(map(c_check, VECTORS)))
    program = tmp_path / "header_vectors"
    source = Path(__file__).with_name("header_vectors.c")
    run(cc, "-std=c11", *STRICT, "-I", tmp_path, source, "-o", program)
    run(program)


def c_check(vector: dict[str, Any]) -> str:
    """One vector as a call of check() in header_vectors.c."""
    fields = dict(vector["fields"])
    counts, payload, counts_given = fields.pop("counts", []), "NULL, 0", "NULL, 0, 0, 0"
    declarations = []
    if vector["packet"] in ("Samples", "Packed", "Quiet"):
        flags = FLAG_SYNC * fields.pop("sync") | FLAG_OVERRUN * fields.pop("overrun")
        flags |= FLAG_CALLED * fields.pop("called") | fields.pop("turn") << TURN_SHIFT
        fields["flags"] = flags
    if counts:
        declarations.append(f"static const int16_t counts[] = {c_value(counts)};")
        base, step = fields.get("base", 0), fields.get("step", 0)
        counts_given = f"counts, {len(counts)}, {base}, {step}"
    type_name = PacketType(vector["type"]).name
    if fields:
        tag = f"struct tp_{type_name.lower()}"
        declarations.append(f"static const {tag} payload = {c_value(fields)};")
        payload = "&payload, sizeof payload"
    return (
        f"{{ {' '.join(declarations)}\n"
        f'check("{vector["name"]}", TP_{type_name}, {vector["sequence"]}, '
        f'{payload}, {counts_given}, "{vector["wire"]}"); }}\n'
    )


def c_value(value: Any) -> str:
    """A C initializer."""
    match value:
        case dict():
            members = (f".{name} = {c_value(member)}" for name, member in value.items())
            return f"{{{', '.join(members)}}}"
        case list():
            return f"{{{', '.join(map(c_value, value))}}}"
        case str():
            return c_value(list(bytes.fromhex(value)))
        case bool():
            return str(int(value))
        case float():
            return f"{value!r}f"
    return f"{value}ull" if value >= 2**31 else f"{value}ll" if value < -(2**31) else str(value)
