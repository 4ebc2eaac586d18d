# SPDX-License-Identifier: Apache-2.0

"""For how long a skin is blind after a lost frame: `make bench-loss`.

A driver's session and pipeline listen to a simulated skin in virtual time, and one packet after the
other is damaged, each alone. Blind is a frame in which a taxel has no certain reading. "asked": the
driver asks all nodes to speak; else by firmware that does not know the command, where a heartbeat
ends it. wrong: words that nobody sent; unflagged: readings that are none of what a node said last,
without a doubt. speaking_share: of the nodes, in a frame of a hug, by either rule; see speaking.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.hardware.node_memory import CHANGE, REST
from tactile_cdma.readings.status import is_certain
from test.support.lost_frames import SKINS, LossyLink, blind, is_blind

from .report import QUICK, Report
from .speaking import hug, speaking, torso, touched
from .style import sheet

LOSSES = {"16": 12, "900": 4, "sparse": 3} if QUICK else {"16": 120, "900": 40, "sparse": 20}
APART_S = 0.7, 1.0
"""s from a loss to the next one, drawn between these; 1.8 times that without asking."""
HEARTBEAT_S = 1.8
SHOWN = 90
"""Frames after a loss that are drawn."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Holds what happened to a skin.

    first_full: number of the first frame that is not blind, from 1 on. blind: those that are, by
    loss. certain: share of certain taxels in the frames after a loss, mean, SHOWN of them.
    requests: that all nodes speak. wrong, unflagged: see the module.
    """

    first_full: int
    blind: list[int]
    certain: list[float]
    requests: int
    wrong: int
    unflagged: int


def main() -> None:
    report = Report("loss", "Frames in which a skin is blind after a lost one")
    found = {(name, asks): lose(name, asks) for name in SKINS for asks in (True, False)}
    report.table(
        ("nodes", "asked", "losses", "blind frames, median", "most", "first full", "requests",
         "wrong", "unflagged"),
        [
            (
                name, "yes" if asks else "no", len(each.blind), statistics.median(each.blind),
                max(each.blind), each.first_full, each.requests, each.wrong, each.unflagged,
            )
            for (name, asks), each in found.items()
        ],
    )  # fmt: skip
    results = {f"blind_frames_{name}": max(found[name, True].blind) for name in SKINS}
    shares = speaking((skin := torso()).spec, touched(skin, hug))
    report.finish(
        draw(found),
        **results,
        first_full_frames_16=found["16", True].first_full,
        **{f"speaking_share_{rule}": float(shares[rule].mean()) for rule in (REST, CHANGE)},
        wrong=sum(each.wrong for each in found.values()),
        unflagged=sum(each.unflagged for each in found.values()),
    )


def lose(name: str, asks: bool) -> Losses:
    """Lose frames of a skin, one by one; asks: its digitizer knows how to ask the nodes."""
    rng = np.random.default_rng(1)
    link = LossyLink(name, knows=asks)
    slower = 1.0 if asks else HEARTBEAT_S
    begin = link.go_on(slower * APART_S[1])
    counts, shares = [], []
    for _ in range(LOSSES[name]):
        link.line.harmed = 1
        frames = link.go_on(slower * rng.uniform(*APART_S))
        counts.append(blind(frames))
        shares.append([certain(frame) for frame in frames])
    first_full = next((n for n, frame in enumerate(begin, 1) if not is_blind(frame)), 0)
    drawn = min(SHOWN, *map(len, shares))
    mean = np.mean([share[:drawn] for share in shares], axis=0).tolist()
    asked = link.pipeline.asking.requests if asks else 0
    return Losses(first_full, counts, mean, asked, link.wrong, link.unflagged)


def certain(frame: TactileFrame) -> float:
    """Share of the taxels with a certain reading."""
    readings = frame.readings
    return float(np.mean(is_certain(readings.status) & np.isfinite(readings.pressure_pa)))


def draw(found: dict[tuple[str, bool], Losses]) -> Figure:
    """Draw how many taxels are certain after a loss."""
    figure = sheet(430)
    axes = figure.subplots()
    for number, name in enumerate(SKINS):
        for asks, style in ((True, "-"), (False, ":")):
            share = found[name, asks].certain
            label = f"{name}{'' if asks else ', not asked'}"
            axes.plot(range(1, len(share) + 1), share, style, color=f"C{number}", label=label)
    axes.set(xlabel="frames after a lost one", ylabel="share of certain taxels", ylim=(0, 1.03))
    axes.set_xscale("log")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
