# SPDX-License-Identifier: Apache-2.0

"""Claims beside the words: zeros after many tares, values between fast frames, printed silences.

Zeros: over restarts. Values: of frames that come faster than told. Silences: as `tactile-cdma
decode` prints them. What was pressed, sent and when is that of an independent line.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from tactile_cdma.base.errors import RestError
from tactile_cdma.commands.decode import describe_frame
from test.support.independent_line import SILENT, Digitizer, Line, Skin, Talk, render

from .tally import Tally
from .words import play
from .zeros import CONTACT_PA, HELD, SLACK_KPA, TARED, Tared

MEANS = Digitizer(samples_per_chip=8, integrated=True)
STEP_KPA, TARES = 0.9, 8
"""Load that is added before each tare, less than a tare is refused for; and how many there are."""
AGAIN = 100
"""Frames from one tare to the next; a tare takes a second."""


@dataclass(frozen=True)
class TareCondition:
    """Has a skin tared again and again, unforced, under ever more load.

    anew: what comes after each tare: "" nothing, a "restart" by what is kept on file, or the same
    "curves" once more.
    """

    name: str
    anew: str
    rough: bool = True
    skin: Skin = field(default_factory=Skin)

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Count readings of no load where there is more than two tares may hide."""
        loads_kpa = tuple(STEP_KPA * n for n in range(TARES + 1) for _ in range(AGAIN // HELD))
        talk = Tared(loads_kpa=loads_kpa, all_pressed=True)
        truth_kpa = talk.pressures_kpa(self.skin)
        seeds = [zlib.crc32(self.name.encode()), seed]
        recording = render(self.skin, talk, Line(), MEANS, len(truth_kpa), seeds)
        claims, false, complaints = 0, 0, list[str]()
        for frame, pipeline in play(recording, v0_v=talk.rest_v):
            taxels, rest = pipeline.taxels, pipeline.taxels.baseline
            zero = np.abs(frame.readings.pressure_pa) <= CONTACT_PA
            most_kpa = 2e-3 * CONTACT_PA + SLACK_KPA
            wrong = int(np.count_nonzero(zero & (truth_kpa[frame.sequence] > most_kpa)))
            claims, false = claims + int(np.count_nonzero(zero)), false + wrong
            if wrong:
                complaints.append(f"  frame {frame.sequence}: {wrong} zeros under load")
            if frame.sequence % AGAIN == TARED - HELD:  # before the load changes
                with suppress(RestError):
                    taxels.tare(CONTACT_PA, force=False)
                if self.anew == "restart":
                    kept = rest.rest_v, rest.drift_v, rest.tared_drift_v, rest.least_v
                    taxels.restore(*kept)
                elif self.anew:
                    taxels.calibrate(pipeline.config.calibration)
        return Tally(claims=claims, tares=false), complaints


@dataclass(frozen=True)
class FastCondition:
    """Tells the driver a longer period than the frames of a line have.

    period: that is told, in those of the line. hit: frames are lost, as impulses on the line hit
    them; else some packets are.
    """

    name: str
    digitizer: Digitizer
    period: float
    hit: bool
    rough: bool = True

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Count certain values that are not the last ones that were sent."""
        skin = Skin()
        line = Line(impulses_hz=100.0, impulse_v=50.0, impulse_chips=20.0) if self.hit else Line()
        recording = render(skin, Talk(share=0.15), line, self.digitizer, frames, seed)
        told_ms = 1e3 * skin.chip_s * skin.period_chips * self.period
        starts = np.array([frame.start_chips for frame in recording.frames])
        sent, now, claims, false = np.full(skin.nodes, SILENT), 0, 0, 0
        complaints = list[str]()
        for frame, pipeline in play(
            recording, lost=0.05 * (not self.hit), seed=seed, frame_period_ms=told_ms
        ):
            number = int(np.argmin(np.abs(starts - frame.t_start / skin.chip_s)))
            for truth in recording.frames[now : number + 1]:
                sent = np.where(truth.codes == SILENT, sent, truth.codes)
            now, readings = number + 1, frame.readings
            claimed = ~np.isnan(readings.certain_voltage_v)
            true_v = pipeline.config.adc.voltage(sent)
            wrong = claimed & ~np.isclose(readings.voltage_v, true_v, atol=1e-4)
            claims += int(np.count_nonzero(claimed))
            false += int(np.count_nonzero(wrong))
            if wrong.any():
                complaints.append(
                    f"  frame {number}: nodes {np.flatnonzero(wrong) + 1} hold others"
                )
        return Tally(claims=claims, fast_frames=false), complaints


@dataclass(frozen=True)
class DecodeCondition:
    """Has `decode` print a line of which some nodes are faint; half of the nodes speak.

    faint: these; gain: of their amplitude.
    """

    name: str
    faint: range
    gain: float
    digitizer: Digitizer = Digitizer(samples_per_chip=4)  # noqa: RUF009  (frozen)
    rough: bool = True

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Count nodes that spoke and are printed as silent, without a doubt."""
        gains = tuple((node, self.gain) for node in self.faint)
        line, seeds = Line(noise_v=0.02, gains=gains), [zlib.crc32(self.name.encode()), seed]
        recording = render(Skin(), Talk(share=0.5), line, self.digitizer, frames, seeds)
        starts = np.array([frame.start_chips for frame in recording.frames])
        claims, false, complaints = 0, 0, list[str]()
        for frame, pipeline in play(recording):
            off_chips = np.abs(starts - frame.t_start / recording.skin.chip_s)
            number = int(np.argmin(off_chips))
            if off_chips[number] > recording.skin.period_chips / 2:  # behind the last one
                continue
            said = describe_frame(frame.t_start, frame.words, pipeline.config)
            silent = set(range(1, recording.skin.nodes + 1)) - set(said["doubtful_silence"])
            silent -= {node["node"] for node in said["nodes"]}
            spoke = set((np.flatnonzero(recording.frames[number].codes != SILENT) + 1).tolist())
            claims, false = claims + len(silent), false + len(silent & spoke)
            if silent & spoke:
                complaints.append(f"  frame {number}: {silent & spoke} printed as silent")
        return Tally(claims=claims, decode_silent=false), complaints


def conditions() -> Iterator[TareCondition | FastCondition | DecodeCondition]:
    """Yield all conditions."""
    for anew in ("", "restart", "curves"):
        yield TareCondition(f"tares: eight of 0.9 kPa, {anew or 'at once'}", anew)
    for name, digitizer in {"raw": Digitizer(), "means": MEANS}.items():
        for period in (1.0, 1.5, 1.7, 2.0, 3.0):
            for hit in (False, True):
                lost = "frames hit" if hit else "packets lost"
                text = f"fast frames: {name}, {period:g} of the period told, {lost}"
                yield FastCondition(text, digitizer, period, hit)
    for gain in (0.15, 0.2, 0.3, 0.45, 1.0):
        for faint in (range(0, 16, 3), range(16)):
            text = f"decode: {len(faint)} nodes at {gain:g} of their amplitude"
            condition = DecodeCondition(text, faint, gain)
            yield condition
            yield replace(
                condition,
                name=f"{condition.name}, without marks",
                digitizer=Digitizer(samples_per_chip=8, marked=False),
            )
