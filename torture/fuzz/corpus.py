# SPDX-License-Identifier: Apache-2.0

"""The kept inputs of every fuzz target: test/corpus/TARGET.txt, one line "NAME HEX" per input.

    python -m torture.fuzz.corpus add TARGET FILE…        keep what a search found
    python -m torture.fuzz.corpus unpack TARGET FOLDER    a file per input, as fuzzers want them

A target is one of torture/fuzz/targets.py, or firmware_NAME for firmware/fuzz/fuzz_NAME.c. Uses
the standard library alone: firmware/fuzz/rules.mk runs it with any Python.
"""

from __future__ import annotations

import argparse
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "test" / "corpus"


def read(target: str) -> dict[str, bytes]:
    """The kept inputs of a target by name; none if nothing was kept."""
    path = FOLDER / f"{target}.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    pairs = (line.partition(" ") for line in lines)
    return {name: bytes.fromhex(data) for name, _, data in pairs}


def add(target: str, files: list[Path]) -> None:
    """Keep inputs under the names of their files."""
    kept = read(target) | {file.name.replace(" ", "_"): file.read_bytes() for file in files}
    lines = [f"{name} {data.hex()}".rstrip() + "\n" for name, data in sorted(kept.items())]
    (FOLDER / f"{target}.txt").write_text("".join(lines))


def unpack(target: str, folder: Path) -> None:
    """Write every kept input to a file of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in read(target).items():
        (folder / name).write_bytes(data)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(prog="python -m torture.fuzz.corpus", description=__doc__)
    parser.add_argument("action", choices=["add", "unpack"])
    parser.add_argument("target")
    parser.add_argument("paths", type=Path, nargs="+", metavar="path")
    arguments = parser.parse_args()
    if arguments.action == "add":
        add(arguments.target, arguments.paths)
    else:
        unpack(arguments.target, arguments.paths[0])


if __name__ == "__main__":
    main()
