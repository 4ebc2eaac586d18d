# SPDX-License-Identifier: Apache-2.0

"""Time and error of a frame's correlation against code order, compared with other methods.

Timed are frames of 10 bits, as the decoder gets them: float32 chips in, float32 volts out, scaled
by 1/N in every case; the memory for the result is there beforehand. All on one thread:

- ours: `correlate`, for any order;
- dense: one matrix product with all code rows, what the paper's MATLAB amounts to;
- butterfly: the textbook's fast Walsh-Hadamard transform in plain numpy, powers of two only;
- C: the same in C with SIMD (fht_cpu 1.0, the fastest that PyPI offers), powers of two only.

The error is the largest of a sample of rows, against those rows in float64, over the RMS of all
correlations of its bit.
"""

from __future__ import annotations

from collections.abc import Callable

import fht_cpu
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tactile_cdma.code.codes import code_book
from tactile_cdma.code.transform import correlate, spread

from .report import QUICK, Report, medians_s
from .style import sheet

BITS = 10
POWERS = [1 << m for m in range(4, 17)]
OTHERS = [20, 144, 1040, 4160, 16_416, 65_520]
"""Paley's matrices and products: defaults for 16, 1024 and 16,385 nodes, and two harder ones."""
DENSE_LARGEST = 4160 if QUICK else 16_384  # 1 GB
ROUNDS = 7 if QUICK else 31
SAMPLE = 200
BATCH = 100
WAYS = ("ours", "dense", "butterfly", "C")


def frame(order: int, rng: np.random.Generator, frames: int = 1) -> NDArray[np.float32]:
    """Return chips of words from every node: (frames·BITS, N) float32, V, with 5 mV of noise."""
    symbols = rng.choice(np.array([-0.3, 0.3], dtype=np.float32), (frames * BITS, order))
    chips = spread(symbols, code_book(order))
    return chips + rng.normal(0, 5e-3, chips.shape).astype(np.float32)


def butterfly(chips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the textbook fast Walsh–Hadamard transform, vectorised."""
    values = chips.copy()
    half = 1
    while half < chips.shape[1]:
        pairs = values.reshape(len(chips), -1, 2, half)
        above, below = pairs[:, :, 0], pairs[:, :, 1]
        pairs[:, :, 0], pairs[:, :, 1] = above + below, above - below
        half *= 2
    values *= np.float32(1.0 / chips.shape[1])
    return values


def ways(chips: NDArray[np.float32]) -> dict[str, Callable[[], NDArray[np.float32]]]:
    """Return all methods that can correlate chips of this order, by name."""
    order = chips.shape[1]
    book, scale, out = code_book(order), np.float32(1.0 / order), np.empty_like(chips)
    calls: dict[str, Callable[[], NDArray[np.float32]]] = {
        "ours": lambda: correlate(chips, book, out=out)
    }
    if order <= DENSE_LARGEST:
        matrix = book.matrix.astype(np.float32)
        matrix *= scale
        calls["dense"] = lambda: np.matmul(chips, matrix.T, out=out)
    if order in POWERS:
        calls["butterfly"] = lambda: butterfly(chips)
        calls["C"] = lambda: np.multiply(fht_cpu.fht(chips, out=out, num_threads=1), scale, out=out)
    return calls


def relative_error(
    found: NDArray[np.float32], chips: NDArray[np.float32], rng: np.random.Generator
) -> float:
    """Largest error of a sample of rows, over the RMS of all correlations of their bit."""
    order = chips.shape[1]
    rows = np.unique([0, *rng.integers(0, order, SAMPLE)])
    exact = chips.astype(np.float64) @ code_book(order).rows(rows).T.astype(np.float64) / order
    rms = np.sqrt(np.square(chips.astype(np.float64)).mean(axis=1, keepdims=True))
    return float(np.max(np.abs(found[:, rows] - exact) / rms))


def batch_gain(rng: np.random.Generator) -> tuple[float, float]:
    """Time per frame at N = 16, s: frames one at a time, and many in one call."""
    chips, book = frame(16, rng, BATCH), code_book(16)
    single, out = chips[:BITS], np.empty_like(chips)
    single_out = out[:BITS]
    times = medians_s(
        {
            "alone": lambda: correlate(single, book, out=single_out),
            "batch": lambda: correlate(chips, book, out=out),
        },
        ROUNDS,
    )
    return times["alone"], times["batch"] / BATCH


def main() -> None:
    report = Report("speed", "Correlation of a frame of 10 bits: time, and error over RMS")
    rng = np.random.default_rng(1)
    times: dict[int, dict[str, float]] = {}
    errors: dict[int, dict[str, float]] = {}
    for order in sorted(POWERS + OTHERS):
        chips = frame(order, rng)
        calls = ways(chips)
        times[order] = medians_s(calls, ROUNDS)
        errors[order] = {name: relative_error(call(), chips, rng) for name, call in calls.items()}
    report.table(
        ["N", "factors", *(f"{way} {what}" for way in WAYS for what in ("µs", "error"))],
        [
            [order, factors(order)]
            + [
                value
                for way in WAYS
                for value in (
                    (times[order][way] * 1e6, f"{errors[order][way]:.1e}")
                    if way in times[order]
                    else ("", "")
                )
            ]
            for order in times
        ],
    )
    alone, batch = batch_gain(rng)
    report.table(
        ["N = 16", "µs per frame"],
        [["one at a time", alone * 1e6], [f"{BATCH} in one call", batch * 1e6]],
    )
    at_4096 = times[4096]
    report.finish(
        picture(times, errors),
        speedup_4096=at_4096["dense"] / at_4096["ours"],
        vs_c_4096=at_4096["ours"] / at_4096["C"],
        batch_gain_16=alone / batch,
        max_rel_error=max(error["ours"] for error in errors.values()),
    )


def factors(order: int) -> str:
    """Return the Kronecker factors of a code book, as 2⁴·20."""
    plan = code_book(order).plan
    twos = plan.count(2)
    power = [f"2^{twos}"] if twos else []
    return "·".join(power + [str(factor) for factor in plan if factor != 2])


def picture(times: dict[int, dict[str, float]], errors: dict[int, dict[str, float]]) -> Figure:
    figure = sheet(760)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    for way, colour in zip(WAYS, ("C0", "C3", "C1", "C2"), strict=True):
        orders = [order for order in times if way in times[order]]
        lines = [order for order in orders if order in POWERS]
        points = [order for order in orders if order not in POWERS]
        for axes, values, factor in ((above, times, 1e6), (below, errors, 1.0)):
            axes.loglog(
                lines, [values[n][way] * factor for n in lines], "o-", color=colour, label=way
            )
            axes.loglog(
                points, [values[n][way] * factor for n in points], "x", color=colour, ms=8, mew=2
            )
    above.set_ylabel("time per frame, µs")
    above.set_title(
        "Correlating a frame of 10 bits, one thread (×: orders that are no power of two)"
    )
    above.legend()
    below.set(ylabel="largest error / RMS", xlabel="code order N, chips per bit")
    below.set_xticks([16, 64, 256, 1024, 4096, 16_384, 65_536], minor=False)
    below.set_xticklabels(["16", "64", "256", "1024", "4096", "16384", "65536"])
    for axes in (above, below):
        axes.grid(which="major", alpha=0.3)
        axes.minorticks_off()
    return figure


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
