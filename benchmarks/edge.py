# SPDX-License-Identifier: Apache-2.0

"""A policy learnt on SkinBatch, on the whole simulated chain: `make bench-edge`.

Trains examples/edge_env.py, a finger that centres itself over an edge, and lets the network act in
the batch and in the chain. Needs torch and gymnasium, which are not installed by itself.
"""

from __future__ import annotations

import sys
from importlib import import_module

from .report import QUICK, ROOT, Report
from .style import sheet

ROUNDS, EPISODES = (10, 8) if QUICK else (40, 48)
ENVS = 256


def main() -> None:
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        example = import_module("edge_env")
    except ImportError as error:
        raise SystemExit(f"bench-edge: {error}: pip install torch gymnasium") from None
    report = Report("edge", "A finger learns on SkinBatch to centre itself over an edge")
    example.torch.set_num_threads(1)
    found = example.results(ROUNDS, ENVS, EPISODES)
    figure = sheet(420)
    axes = figure.subplots()
    names = ("start", "batch", "chain")
    axes.bar(names, [found[f"{name}_mm"] for name in names])
    axes.set(ylabel="edge off the middle, mm (median)")
    report.finish(figure, **found)


if __name__ == "__main__":
    main()
