# SPDX-License-Identifier: Apache-2.0

"""A ball of 0.2 kg on 4 × 4 taxels, in SkinBatch, Genesis and MuJoCo: cost of a frame, and force.

Each rival runs by itself, in the Python that a variable names (GENESIS_PYTHON, MUJOCO_PYTHON), else
in this one; what is not installed there is told, and left out. Genesis compiles for minutes. All
are given one core. docs/results.md tells which faults each of them models.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from ..report import ROOT, Report
from ..style import sheet
from .ours import EARTH_N_PER_KG
from .scene import MASS_KG

WEIGHT_N = MASS_KG * EARTH_N_PER_KG
ONE_CORE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "QD_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Rival:
    """module: of this folder. needs: what is imported; package: what PyPI calls it."""

    name: str
    module: str
    needs: str
    package: str

    def found(self) -> dict[str, Any] | None:
        """Run it; returns what it told, None if it is not installed."""
        python = os.environ.get(f"{self.needs.upper()}_PYTHON", sys.executable)
        probe = f"import importlib.util as u, sys; sys.exit(u.find_spec({self.needs!r}) is None)"
        if subprocess.run([python, "-c", probe], cwd=ROOT).returncode:
            print(
                f"{self.name}: not installed: pip install {self.package}, in an environment of its "
                f"own that {self.needs.upper()}_PYTHON names"
            )
            return None
        command, environment = [python, "-m", f"benchmarks.rivals.{self.module}"], os.environ
        run = subprocess.run(
            command, cwd=ROOT, env={**environment, **ONE_CORE}, text=True, stdout=subprocess.PIPE
        )
        if run.returncode:
            print(f"{self.name}: failed, see above")
            return None
        told: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
        return told


RIVALS = (
    Rival("SkinBatch", "ours", "tactile_cdma", "."),
    Rival("Genesis KinematicTaxel", "genesis_taxels", "genesis", "genesis-world torch"),
    Rival("MuJoCo touch_grid", "mujoco_touch_grid", "mujoco", "mujoco"),
)


def main() -> None:
    report = Report("rivals", f"A ball of {WEIGHT_N:.3f} N on 4 × 4 taxels, one core")
    rows: list[list[Any]] = []
    results: dict[str, float | str] = {}
    for rival in RIVALS:
        if (found := rival.found()) is None:
            results[f"{rival.module}_us"] = "not_installed"
            continue
        forces_n, frame_us = found["forces_n"], found["frame_us"]
        touched, total_n = sum(force_n > 0 for force_n in forces_n), sum(forces_n)
        physics_us, sensor_us = found["step_us"] or "none", frame_us - found["step_us"]
        results |= {f"{rival.module}_us": sensor_us, f"{rival.module}_force_n": total_n}
        name, envs = f"{rival.name} {found['version']}", found["envs"]
        rows.append([name, envs, physics_us, sensor_us, 1e6 / frame_us, total_n, touched])
    headers = ["", "environments", "physics, µs", "touch, µs", "frames/s", "force, N", "taxels"]
    report.table(headers, rows)
    report.finish(picture(rows), **results)


def picture(rows: list[list[Any]]) -> Figure:
    """Draw what touch takes."""
    figure = sheet(240)
    axes = figure.subplots()
    axes.barh([row[0] for row in rows], [row[3] for row in rows])
    axes.set(xlabel="µs of CPU for touch, per environment and frame")
    return figure


if __name__ == "__main__":
    main()
