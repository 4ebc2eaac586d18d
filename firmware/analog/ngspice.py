# SPDX-License-Identifier: Apache-2.0

"""Runs ngspice and reads what it finds."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from amplifier import FrontEnd
from circuit import level_points, netlist, noise_netlist, steps_of


class SpiceError(RuntimeError):
    """ngspice is not installed, or failed."""


def waveform(
    front: FrontEnd,
    levels: NDArray[np.float64],
    chip_s: float,
    end_s: float,
    released: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulate a front end: times, s, and voltages at the converter, V.

    levels: (m, span) levels of nodes in every chip, −1…1, from time 0 on, and 0 after them: see
    netlist. released: mean of the levels of pins that are released when a chip begins, (span + 1,),
    where a mean of levels does not tell it: see level_points.
    """
    with TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"levels{number}.txt") for number in range(len(levels))]
        for file, own in zip(files, levels, strict=True):
            np.savetxt(file, level_points(own, chip_s, front.tail_s, released), fmt="%.17g")
        return transient(netlist(front, files, end_s, steps_of(chip_s, front.tail_s)))


def transient(text: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Run a netlist's transient analysis that saves one voltage: times, s, and voltages, V."""
    times, volts = transients(text).values()
    return times, volts


def transients(text: str) -> dict[str, NDArray[np.float64]]:
    """Run a netlist's transient analysis: "time", s, and each v(node) that it saves, V, by name."""
    with TemporaryDirectory() as folder:
        raw = Path(folder) / "out.raw"
        said = _run(Path(folder), text, "-r", str(raw))
        written = raw.read_bytes() if raw.exists() else b""
    head, _, body = written.partition(b"Binary:\n")
    names = re.findall(rb"^\t\d+\t(\S+)\t", head, re.MULTILINE)
    points = re.search(rb"No. Points: (\d+)", head)
    if points is None:
        raise SpiceError(f"ngspice wrote no points: {head[:500]!r}; it said {said[-500:]}")
    if len(body) != (wanted := int(points[1]) * len(names) * 8) or not body:
        raise SpiceError(f"ngspice wrote {len(body)} of {wanted} bytes: is the disk full?")
    columns = np.frombuffer(body, "<f8").reshape(-1, len(names)).T
    return {name.decode(): column for name, column in zip(names, columns, strict=True)}


def noise_v(front: FrontEnd) -> float:
    """Simulate the RMS noise at the converter, V, of all amplifiers, followers and resistors."""
    paths = [front.groups] if front.groups_stage else []
    if front.attenuator:
        paths.append(front.nodes)
    powers = [_noise_v(front, depth) ** 2 for depth in range(1, len(paths) + 2)]
    # what an amplifier of a group, if there are any, and a follower add
    return float(np.sqrt(powers[0] + np.dot(paths, np.diff(powers))))


def _noise_v(front: FrontEnd, depth: int) -> float:
    with TemporaryDirectory() as folder:
        said = _run(Path(folder), noise_netlist(front, depth, 1e9))
    found = re.search(r"onoise_total = (\S+)", said)
    if not found:
        raise SpiceError(f"ngspice found no noise: {said[-500:]}")
    return float(found[1])


def _run(folder: Path, text: str, *options: str) -> str:
    """Return what ngspice prints for a netlist."""
    program = shutil.which("ngspice")
    if program is None:
        raise SpiceError("no ngspice on this machine: apt install ngspice")
    source = folder / "circuit.cir"
    source.write_text(text)
    result = subprocess.run(
        # -n: a .spiceinit of the user's could ask for another format
        [program, "-n", "-b", *options, str(source)],
        capture_output=True,
        text=True,
        cwd=folder,
    )
    said = result.stdout + result.stderr
    if result.returncode or "aborted" in said:
        raise SpiceError(f"ngspice failed: {said[-800:]}")
    return said
