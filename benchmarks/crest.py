# SPDX-License-Identifier: Apache-2.0

"""Peaks of the summed line, and the converter they require, by signs of the code rows.

n = N − 1 nodes share a Sylvester book of order N (row 0 is free), and all of them talk in every
frame: the scenes of the simulator, of which "idle" is the worst case, all nodes with one code.

- natural: all rows as they are, as in the paper;
- random: the driver's default, the hash of a seed and the row (worst of several seeds);
- bent: signs of a bent function of the row, −1 to the number of ones that its two halves have in
  common; then equal words add up to a line of constant level (N a power of 4).

The crest factor is the largest chip of a frame over the RMS of the frame; the worst frame counts.

Bit errors are counted with noise on the line that gives ρ = 3, 1.35e-3 errors per bit, behind a
converter with a full scale of ±c·√n·A; the frames are the same for all converters. The ADC bits
that suffice are the fewest with at most 1.1 times the errors of the unquantised line (0.09 dB) at
the best c.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_cdma.code.codes import code_book, row_signs
from tactile_cdma.code.encode import word_bits
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate, spread
from tactile_cdma.sim.nodes import NodeRules, node_frames
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES

from .report import QUICK, Report

ORDERS = (16, 64, 256, 1024, 4096)
SCHEMES = ("natural", "random", "bent")
SEEDS = range(1, 4 if QUICK else 11)
FRAMES = 4 if QUICK else 12
"""Frames of each scene, 0.37 s apart."""
RHO = 3.0
NOISES = 4 if QUICK else 16
"""Repetitions of each scene's frames for every converter, each with its own noise."""
SCALES = (2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Full scales c that are tried, besides √n, which fits every sum."""
ADC_BITS = range(3, 14)
TOLERANCE = 1.1


def words(order: int, scene: str, frames: int) -> Iterator[NDArray[np.float32]]:
    """Symbols ±1 of some frames of a scene, (k, N) float32 each, row signs not applied."""
    spec = FrameSpec(nodes=order - 1, order=order, chip_s=1e-6, frame_period_s=0.37)
    said = node_frames(spec, SCENES[scene], SimOptions().skin(spec.nodes), NodeRules(threshold=0))
    for _ in range(frames):
        symbols = np.zeros((spec.bits, order), dtype=np.float32)
        symbols[:, spec.rows] = 2.0 * word_bits(next(said).codes, spec.bits).T - 1.0
        yield symbols


def signs(order: int, scheme: str, seed: int = 1) -> NDArray[np.int8]:
    """Sign of every code row, (N,) of ±1."""
    rows = np.arange(order)
    if scheme == "bent":
        half = (order.bit_length() - 1) // 2
        common = (rows >> half) & rows & ((1 << half) - 1)
        return np.array([1 - 2 * (value.bit_count() % 2) for value in common.tolist()], np.int8)
    return row_signs(rows, None if scheme == "natural" else seed)


def crest(order: int, scheme: str, scene: str) -> float:
    """Largest ratio of peak to RMS over all frames, and seeds if the signs have any."""
    largest = 0.0
    for symbols in words(order, scene, FRAMES):
        for seed in SEEDS if scheme == "random" else (1,):
            line = spread(symbols * signs(order, scheme, seed), code_book(order))
            largest = max(largest, float(np.abs(line).max() / np.sqrt(np.square(line).mean())))
    return largest


class Converter:
    """Bit errors of one sign scheme behind converters of different range and resolution."""

    def __init__(self, order: int, scheme: str) -> None:
        rng = np.random.default_rng(order)
        self.book, self.nodes = code_book(order), order - 1
        self.signs = signs(order, scheme)
        self.sent = [symbols for scene in SCENES for symbols in words(order, scene, NOISES)]
        noise_rms = math.sqrt(order) / RHO
        self.lines = [
            spread(symbols * self.signs, self.book)
            + rng.normal(0.0, noise_rms, symbols.shape).astype(np.float32)
            for symbols in self.sent
        ]

    def error_rate(self, scale: float = math.inf, bits: int | None = None) -> float:
        """Share of wrong bits; scale: full scale over √n·A. bits: None does not quantise."""
        full = scale * math.sqrt(self.nodes)
        wrong = 0
        for symbols, line in zip(self.sent, self.lines, strict=True):
            if bits is None:
                seen = np.clip(line, -full, full)
            else:
                step, half = np.float32(2.0 * full / 2**bits), 1 << (bits - 1)
                seen = np.clip(np.rint(line / step), -half, half - 1) * step
            found = correlate(seen, self.book) * self.signs
            wrong += int(np.count_nonzero((found > 0) != (symbols > 0), axis=0)[1:].sum())
        total: int = len(self.sent) * self.sent[0].shape[0] * self.nodes
        return wrong / total


def main() -> None:
    report = Report("crest", "Peak over RMS of the line, and ADC bits, by signs of the code rows")
    crests = {
        (order, scheme): {scene: crest(order, scheme, scene) for scene in SCENES}
        for order in ORDERS
        for scheme in SCHEMES
    }
    report.table(
        ["N", "signs", *("one code" if scene == "idle" else scene for scene in SCENES)],
        [[order, scheme, *scenes.values()] for (order, scheme), scenes in crests.items()],
    )
    curves: dict[str, dict[float, list[float]]] = {}
    exact: dict[str, float] = {}
    enough: dict[int, dict[str, int]] = {}
    for order in ORDERS:
        scales = (*SCALES, math.sqrt(order - 1))
        for scheme in SCHEMES:
            converter = Converter(order, scheme)
            unquantised = converter.error_rate()
            rates = {c: [converter.error_rate(c, bits) for bits in ADC_BITS] for c in scales}
            enough.setdefault(order, {})[scheme] = least_bits(rates, unquantised)
            if order == ORDERS[-1]:
                curves[scheme], exact[scheme] = rates, unquantised
    report.table(
        ["N", *(f"ADC bits, {scheme}" for scheme in SCHEMES)],
        [[order, *fewest.values()] for order, fewest in enough.items()],
    )
    report.table(
        [f"bit errors, N = {ORDERS[-1]}", "full scale, √n·A", *(f"{b} bit" for b in ADC_BITS)],
        [
            [scheme, scale, *(f"{rate:.1e}" for rate in rates)]
            for scheme, by_scale in curves.items()
            for scale, rates in by_scale.items()
        ],
    )
    report.finish(
        picture(crests, curves, exact),
        crest_random_4096=max(crests[4096, "random"].values()),
        crest_natural_4096=max(crests[4096, "natural"].values()),
        crest_bent_4096=max(crests[4096, "bent"].values()),
        adc_bits_4096_random=enough[4096]["random"],
        adc_bits_4096_natural=enough[4096]["natural"],
        ber_unquantised_4096=exact["random"],
    )


def least_bits(rates: dict[float, list[float]], unquantised: float) -> int:
    """Fewest ADC bits that suffice, as do all larger numbers, at one of the full scales."""
    return min(
        (
            bits
            for by_bits in rates.values()
            for bits, rate in zip(ADC_BITS, by_bits, strict=True)
            if rate <= TOLERANCE * unquantised
        ),
        default=ADC_BITS.stop,
    )


def picture(
    crests: dict[tuple[int, str], dict[str, float]],
    curves: dict[str, dict[float, list[float]]],
    exact: dict[str, float],
) -> Figure:
    figure = Figure(figsize=(12, 5))
    left, right = figure.subplots(1, 2)
    colours = dict(zip(SCHEMES, ("C3", "C0", "C2"), strict=True))
    for scheme, colour in colours.items():
        worst = [crests[order, scheme]["idle"] for order in ORDERS]
        others = [
            max(v for scene, v in crests[order, scheme].items() if scene != "idle")
            for order in ORDERS
        ]
        left.loglog(ORDERS, worst, "o-", color=colour, label=f"{scheme}, all nodes with one code")
        left.loglog(ORDERS, others, "x--", color=colour, label=f"{scheme}, worst of the scenes")
    left.set_xticks(ORDERS, [str(order) for order in ORDERS])
    left.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    left.minorticks_off()
    left.set_xlabel("nodes (+ 1)")
    left.set_ylabel("peak over RMS of the line")
    left.set_title("Crest factor")
    for scheme, scales in (("random", (2.0, 3.0, 5.0)), ("natural", (5.0, math.sqrt(4095)))):
        for scale, style in zip(scales, ("-", "--", ":"), strict=False):
            label = f"{scheme}, ±{scale:.3g}·√n·A"
            rates = curves[scheme][scale]
            right.semilogy(ADC_BITS, rates, style, marker=".", color=colours[scheme], label=label)
    right.axhline(exact["random"], color="black", lw=1, label="not quantised")
    right.set_xlabel("ADC bits")
    right.set_ylabel("bit errors")
    right.set_title(f"Bit errors at ρ = {RHO:g}, N = 4096, by signs and full scale")
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    main()
