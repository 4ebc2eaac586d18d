# SPDX-License-Identifier: Apache-2.0

"""Records episodes of skins, a robot's state and its action, as a dataset to learn from.

    python examples/record_episodes.py grasps --port 'sim://?scene=presses' --task "press it"
    python examples/record_episodes.py grasps --driver /left_palm/skin   # it has the port

Needs pyarrow, not LeRobot, which can load the dataset. Keys: n keeps the episode and begins the
next one, d discards it, q keeps it and ends. Without a terminal, --episodes of --seconds are kept.
Put your robot in place of Arm: state() and action() give any numbers by name. At run time the same
comes live, from a port or from topics:

    observation = LiveObservation("grasps", skin)    # or: with TopicObservation("grasps") as …
    observation.state(arm.state())
    action = policy(observation.read(now=True))
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma import CaptureError, LiveObservation, ObservationError, Skin, TactileError
from tactile_cdma.base.interrupt import terminable
from tactile_cdma.datasets.lerobot.features import Feature
from tactile_cdma.datasets.lerobot.writer import DatasetWriter, lerobot_writer
from tactile_cdma.datasets.progress import Progress
from tactile_cdma.live_observation import Observation
from tactile_cdma.views.live import typed_keys

FPS = 30
MOST_S = 1024
"""LeRobot's float32 timestamps bear no longer episode."""
STATE, ACTION = "observation.state", "action"
KEYS = "n keeps, d discards, q keeps and ends"


class Arm:
    """Joints that follow their commands: what a robot that somebody leads would say."""

    def state(self) -> dict[str, float]:
        """Return where the joints are."""
        return {"elbow": math.sin(time.monotonic()), "wrist": 0.2}

    def action(self) -> dict[str, float]:
        """Return where they are told to go."""
        return {"elbow": math.sin(time.monotonic() + 0.1)}


class EpisodeRecorder:
    """A dataset as `tactile-cdma export --lerobot` writes it, of what a policy would observe live.

    The folder appears with the first episode that is kept, whole, when the context ends, also by an
    exception. rows: of the episode that goes on, in memory. episodes: kept so far.
    """

    def __init__(self, folder: Path, observation: Observation, fps: int = FPS) -> None:
        if folder.exists() or not folder.resolve().parent.is_dir():
            raise CaptureError(f"{folder}: exists already, or its folder is not there")
        self._folder, self._observation, self._fps = folder, observation, fps
        self._names: dict[str, list[str]] = {}
        self._writer: DatasetWriter | None = None
        self._ends = ExitStack()
        self.rows: list[dict[str, NDArray[Any]]] = []

    def __enter__(self) -> EpisodeRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            meta = replace(self._observation.meta, fps=self._fps, features=self._features())
            abouts = self._observation.abouts().items()
            patches = [{**about, "patch": name} for name, about in abouts]
            content = meta.content(f"{self._fps} per s, by the program", False)
            self._writer.finish(content | {"patches": patches, "files": []})
        self._ends.close()

    @property
    def episodes(self) -> int:
        return self._writer.episodes if self._writer else 0

    def add(self, state: Mapping[str, float], action: Mapping[str, float]) -> dict[str, Any]:
        """Observe this moment, with numbers by name; returns the row.

        Raises what Observation.read does, and ValueError for other names than before.
        """
        row = self._observation.read(now=True)
        for column, given in ((STATE, state), (ACTION, action)):
            names = self._names.setdefault(column, list(given))
            if set(given) != set(names):
                raise ValueError(f"{column} has {', '.join(given)}; before {', '.join(names)}")
            row[column] = np.array([given[name] for name in names], dtype=np.float32)
        self.rows.append(row)
        return row

    def discard(self) -> None:
        """Forget the episode that goes on."""
        self.rows.clear()

    def keep(self, task: str) -> None:
        """Write the episode that goes on, if it has a row; the next row begins another one."""
        if not self.rows:
            return
        if self._writer is None:
            writer = lerobot_writer(self._folder, self._features(), self._fps)
            self._writer = self._ends.enter_context(writer)
        masks = [one.name for one in self._features() if one.mask]
        self._writer.begin(task)
        for row in self.rows:
            self._writer.add(row | {name: row[name] > 0 for name in masks})
        self.rows.clear()

    def _features(self) -> list[Feature]:
        own = (
            Feature(column, "float32", (len(names),), tuple(names))
            for column, names in self._names.items()
        )
        return [*self._observation.meta.features, *own]


def paced(rate_hz: float) -> Iterator[float]:
    """Yield so many times a second; each time by how much it is late, s."""
    due_s = time.monotonic()
    while True:
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield time.monotonic() - due_s
        due_s = max(due_s + 1 / rate_hz, time.monotonic() - 1.0)  # it catches up a second at most


@contextmanager
def keys_or_clock(episodes: int, seconds: float, rows: list[Any]) -> Iterator[Callable[[], str]]:
    """Yield a function that returns the keys pressed; without a terminal, as by the clock."""
    if sys.stdin.isatty():
        with typed_keys() as keys:
            yield keys
        return
    left = iter("n" * (episodes - 1) + "q")
    yield lambda: next(left, "q") if len(rows) >= seconds * FPS else ""


def record(recorder: EpisodeRecorder, arm: Arm, keys: Callable[[], str], task: str) -> int:
    """Record until q; returns how many rows came late by more than half an interval."""
    late, waits_for = 0, ""
    with Progress() as progress:
        for late_s in paced(FPS):
            pressed = keys()
            if "d" in pressed:
                recorder.discard()
            elif set("nq") & set(pressed) or len(recorder.rows) >= MOST_S * FPS:
                recorder.keep(task)
            if "q" in pressed:
                return late
            try:
                recorder.add(arm.state(), arm.action())
                late, waits_for = late + (late_s > 0.5 / FPS), ""
            except ObservationError as error:
                if recorder.rows:
                    raise  # rows of an episode follow one another without a gap
                waits_for = f"waits: {error}"
            length_s, number = len(recorder.rows) / FPS, recorder.episodes + 1
            said = waits_for or f"{length_s:.1f} s, {late} rows late"
            progress.at(math.nan, f"episode {number}: {said} ({KEYS})")
    raise AssertionError("paced() never ends")


def main() -> None:
    """Record until told to end."""
    parser = argparse.ArgumentParser(description="records episodes of skins, state and action")
    parser.add_argument("folder", type=Path, help="the new dataset")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--port", help="device, sim:// or replay://FILE")
    source.add_argument("--driver", help="node of a driver that has the port, such as /skin")
    parser.add_argument("--task", default="unnamed", help="what is done, in words")
    parser.add_argument("--episodes", type=int, default=2, help="without a terminal")
    parser.add_argument("--seconds", type=float, default=2.0, help="without a terminal")
    arguments = parser.parse_args()
    with ExitStack() as ends:
        ends.enter_context(terminable())  # so that SIGTERM keeps what was kept, too
        observation: Observation
        if arguments.port:
            skin = ends.enter_context(Skin(arguments.port, contacts=True))
            observation = LiveObservation.of(skin)
        else:
            from tactile_cdma.ros.observation import TopicObservation

            topics = TopicObservation.of({"skin": arguments.driver}, contacts=True)
            observation = ends.enter_context(topics)
        recorder = ends.enter_context(EpisodeRecorder(arguments.folder, observation))
        times = arguments.episodes, arguments.seconds
        keys = ends.enter_context(keys_or_clock(*times, recorder.rows))
        late = record(recorder, Arm(), keys, arguments.task)
        print(f"episodes={recorder.episodes} late={late} folder={arguments.folder}")


if __name__ == "__main__":
    try:
        main()
    except TactileError as error:
        raise SystemExit(f"record_episodes: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("record_episodes: told to end; what was kept is there") from None
