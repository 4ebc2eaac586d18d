#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0

"""Whether another processor decodes to the same bits; part of fresh_machine.sh --arch.

`same_frames.py --write FILE` simulates streams of bytes, decodes them, and keeps both, with
transforms of random values. `same_frames.py FILE` decodes and transforms anew and compares, with
every number of lanes that the processor has.
"""

import argparse
import pickle
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.base import kernel
from tactile_cdma.code.codes import code_book
from tactile_cdma.code.transform import Transform
from tactile_cdma.config.skin_config import SkinConfig
from test.support.same_frames import assert_same
from test.support.simulated import run, stream

LARGE = {"nodes": 256, "chip_us": 8.0, "frame_period_ms": 40.0}
SPARSE = {"codes": "sparse", "nodes": 256, "order": 64, "chip_us": 20.0, "samples_per_chip": 1}
STREAMS: tuple[tuple[dict[str, object], str], ...] = (
    ({}, "scene=moving"),
    ({}, "scene=all&threshold=0&noise=0.3"),
    ({}, "scene=all&threshold=0&stretch=0.1"),
    ({"samples_per_chip": 1}, "scene=all&threshold=0&noise=0.3"),
    ({"parity": True}, "scene=all&threshold=0&noise=0.2"),
    ({"drive": "unipolar"}, "scene=moving"),
    ({"scramble": True}, "scene=all&threshold=0&offset=0.3"),
    ({"timing": "gap"}, "scene=moving"),
    ({"timing": "gap"}, "scene=all&threshold=0&stretch=0.1"),
    (LARGE, "scene=hand"),
    (LARGE | {"samples_per_chip": 1}, "scene=all&threshold=0"),
    (SPARSE, "scene=moving"),
)
"""Parameters and simulated skins: frames that the kernel reads, and some decided in Python."""
FRAMES = 60
"""Per stream; chosen."""
ORDERS = (8, 16, 20, 72, 912, 4096, 16_384)
"""Orders of the transforms: powers of 2, with a factor of Paley's, with two."""


def transforms(values: dict[int, NDArray[np.float32]]) -> dict[int, bytes]:
    """Return the transform of each order's values. Raises SystemExit if it depends on the lanes."""
    found = {}
    for order, chips in values.items():
        results = set()
        for lanes in (1, 4, 8):
            if lanes <= kernel.lib.transform_lanes():
                out = np.empty_like(chips)
                Transform(code_book(order).plan, False, lanes).multiply(chips, out)
                results.add(out.tobytes())
        if len(results) > 1:
            raise SystemExit(f"order {order}: the bits depend on the number of lanes")
        found[order] = results.pop()
    return found


def main() -> int:
    """Write, or compare; the last line of a comparison has what was compared."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--write", action="store_true", help="keep what this processor makes")
    arguments = parser.parse_args()
    configurations = [SkinConfig.of(parameters) for parameters, _ in STREAMS]
    if arguments.write:
        rng = np.random.default_rng(1)
        values = {order: rng.normal(size=(10, order)).astype(np.float32) for order in ORDERS}
        raw = [
            stream(config, f"sim://?{scene}", FRAMES)
            for config, (_, scene) in zip(configurations, STREAMS, strict=True)
        ]
        frames = [run(config, data) for config, data in zip(configurations, raw, strict=True)]
        arguments.file.write_bytes(pickle.dumps((raw, frames, values, transforms(values))))
        return 0
    # This program has made it, a minute ago.
    raw, expected, values, products = pickle.loads(arguments.file.read_bytes())  # noqa: S301
    differ = [order for order, found in transforms(values).items() if found != products[order]]
    for order in differ:
        print(f"the transform of order {order} differs")
    decoded, wrong = 0, 0
    for config, (parameters, scene), data, kept in zip(
        configurations, STREAMS, raw, expected, strict=True
    ):
        frames = run(config, data)
        decoded += len(frames)
        try:
            assert_same(frames, kept)
        except AssertionError as error:
            wrong += 1
            print(f"{parameters} {scene}: {error}")
    wrong += len(differ)
    print(f"streams={len(raw)} frames={decoded} transforms={len(products)} differ={wrong}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
