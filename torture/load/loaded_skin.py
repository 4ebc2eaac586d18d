# SPDX-License-Identifier: Apache-2.0

"""The rig of load and soak: a driver node in its own process, and a subscriber with the truth."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.options import SimOptions
from test.support.boards import plugged
from test.support.domains import own_domain
from test.support.spinning import spinning

from ..outcome import Outcome, Tally
from ..process_watch import memory_kb, waited_s
from .known_digitizer import KnownDigitizer, on_a_socket
from .message_judge import MessageJudge

SKIN_DRIVER = Path(__file__).resolve().parents[2] / "scripts" / "skin_driver"
MOST_STARVED = 10.0
"""Patience with a driver that gets no processor, in times of that with one that does. Chosen."""
DEFECTS = ("Traceback", "internal error")
"""Text that must not be in a driver's log."""
FRESH_S = 0.5
"""Age of the newest message up to which a driver on a busy computer keeps up."""
_TURN_S, _WATCH_S = 0.02, 0.2
_NUMBERS = count()


@dataclass(frozen=True, slots=True)
class Setting:
    """How a skin is set up.

    scene: options of the simulator. parameters: of the driver. reliable: arrays are published and
    subscribed to reliably, so that the driver waits for its subscribers, instead of best effort.
    near_pa, flags: see MessageJudge.
    """

    scene: str
    parameters: Mapping[str, object]
    reliable: bool
    near_pa: float
    flags: Status


LOADED = Setting(
    scene="scene=hand&threshold=0",  # all nodes speak in every frame
    parameters={"drift_pa_per_min": 0.0},  # a word has one pressure: any rounding is seen
    reliable=True,
    near_pa=0.05,
    flags=Status.SATURATED,
)
SOAKED = Setting(
    scene="scene=presses",  # nodes are silent as long as nothing changes
    parameters={},
    reliable=False,
    near_pa=30.0,  # drift is followed; a third of the smallest step between two words
    flags=Status.STALE | Status.UNHEARD,
)


class LoadedSkin:
    """Use as a context manager. patience_s: without progress for so long, something hangs.

    folder: for all files that are written; state_folder: the driver's.
    judge: takes every message. reports: number of messages on /diagnostics. watches: whether to
    subscribe to the heatmap; pictures: how many of it came.
    """

    def __init__(
        self,
        folder: Path,
        seed: int,
        patience_s: float,
        networked: bool = False,
        setting: Setting = LOADED,
        prefix: Sequence[str] = (),
    ) -> None:
        """networked: the digitizer is behind a socket instead of a tty.

        prefix: of the command that starts the driver, which it has to become by exec.
        """
        self._prefix = prefix
        options = SimOptions.from_url(f"sim://?{setting.scene}&seed={seed}")
        self.digitizer = KnownDigitizer(options)
        self.judge = MessageJudge(self.digitizer, setting.near_pa, setting.flags)
        self.reports = self.pictures = 0
        self.watches = False
        self._heatmap: Subscription | None = None
        self.hangs = 0
        namespace = f"/load_{os.getpid()}_{next(_NUMBERS)}"  # others may be in the same domain
        self.name = f"{namespace}/skin"
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(own_domain("networked" if networked else "")),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_HOME": str(folder / "ros"),
        }
        self.folder, self.state_folder = folder, folder / "state"
        self.patience_s, self._networked = patience_s, networked
        self._parameters: dict[str, object] = {"publish_voltage": True, **setting.parameters}
        self._qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        if setting.reliable:
            topic = f"{self.name}/tactile"
            self._parameters[f"qos_overrides.{topic}.publisher.reliability"] = "reliable"
            self._qos.reliability = ReliabilityPolicy.RELIABLE
        self._arguments = ["-r", f"__ns:={namespace}"]
        self._values: dict[str, str] = {}
        self._log_read = 0
        self._stack = ExitStack()

    def __enter__(self) -> LoadedSkin:
        with ExitStack() as stack:
            port = stack.enter_context(
                on_a_socket(self.digitizer)
                if self._networked
                else plugged(lambda: self.digitizer, self.folder / "tty")
            )
            stack.enter_context(self._listening())
            self.process = stack.enter_context(self._driver(port))
            self.judge.waited_s = partial(waited_s, self.process.pid)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    # ---- Actions

    def streams_on(self, frames: int = 20) -> bool:
        """Wait for this many messages; counts a hang if they don't come."""
        wanted = self.judge.tally.frames + frames
        before = -1

        def goes_on() -> bool:
            return self.judge.tally.frames > before

        while before < wanted and self.waits_for(goes_on):
            before = self.judge.tally.frames
        return before >= wanted

    def is_fresh(self) -> bool:
        """Wait until messages are current; counts a hang if they don't get so."""

        def fresh() -> bool:
            return time.monotonic() - self.judge.last_middle_s < FRESH_S

        return self.streams_on(1) and self.waits_for(fresh)

    def is_newest(self, since_s: float) -> bool:
        """Wait for a frame measured after this monotonic time, s; counts a hang otherwise."""
        return self.waits_for(lambda: self.judge.last_middle_s > since_s)

    def waits_for(self, condition: Callable[[], object]) -> bool:
        """Wait for a condition; counts a hang if patience_s pass or the driver ends before.

        The time for which the driver waits for a processor is no part of that, up to MOST_STARVED
        times as long.
        """
        begin_s, idle_s = time.monotonic(), self.judge.waited_s()
        while not condition():
            late_s = time.monotonic() - begin_s - self.patience_s
            starved_s = self.judge.waited_s() - idle_s if late_s > 0 else 0.0
            is_late = late_s > min(starved_s, MOST_STARVED * self.patience_s)
            if is_late or self.process.poll() is not None:
                self.hangs += 1
                return False
            time.sleep(_TURN_S)
        return True

    def stopped_for(self, seconds: float) -> None:
        """Stop the driver by a signal for this time."""
        self.process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self.process.send_signal(signal.SIGCONT)

    def says(self, value: str) -> str:
        """The newest value of a key in /diagnostics; empty if there was none."""
        return self._values.get(value, "")

    @property
    def rss_kb(self) -> int:
        """Resident memory of the driver's process."""
        return memory_kb(self.process.pid)

    def outcome(
        self, fault: str, times: int, said: str = "", uncounted: int = 0, wrong: int = 0
    ) -> Outcome:
        """Sum up since the last outcome. uncounted, wrong: findings besides the judge's."""
        tally, self.judge.tally = self.judge.tally, Tally()
        tally.times = times
        tally.wrong_values += wrong
        tally.uncounted_losses += uncounted
        tally.crashes = self.defects() + (self.process.poll() is not None)
        tally.hangs, self.hangs = self.hangs, 0
        return tally.outcome(fault, said or frames_missing(tally))

    def defects(self) -> int:
        """Number of new lines of the driver's log that show a defect, since the last call."""
        log = (self.folder / "driver.log").read_text()
        new, self._log_read = log[self._log_read :], len(log)
        return sum(new.count(defect) for defect in DEFECTS)

    # ---- Processes and threads

    @contextmanager
    def _driver(self, port: str) -> Iterator[subprocess.Popen[bytes]]:
        command = [*self._prefix, sys.executable, str(SKIN_DRIVER), "--ros-args", *self._arguments]
        values = {"port": port, "state_folder": str(self.state_folder), **self._parameters}
        for name, value in values.items():
            command += ["-p", f"{name}:={json.dumps(value)}"]
        with (self.folder / "driver.log").open("wb") as log:
            process = subprocess.Popen(command, env=self.environment, stderr=log, stdout=log)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(self.patience_s)
            process.kill()
            process.wait()

    @contextmanager
    def _listening(self) -> Iterator[None]:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=int(self.environment["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node("watcher", context=context)
        topic = f"{self.name}/tactile"
        self.node.create_subscription(TactileArray, topic, lambda m: self.judge.take(m), self._qos)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)
        self.node.create_timer(_WATCH_S, self._watch)
        try:
            with spinning([self.node]):
                yield
        finally:
            rclpy.shutdown(context=context)

    def _watch(self) -> None:
        """Subscribe to the heatmap or end that; in the executor's thread, which uses it."""
        if self.watches and self._heatmap is None:
            topic = f"{self.name}/heatmap"
            self._heatmap = self.node.create_subscription(Image, topic, self._seen, 2)
        elif not self.watches and self._heatmap is not None:
            self.node.destroy_subscription(self._heatmap)
            self._heatmap = None

    def _seen(self, picture: Image) -> None:
        self.pictures += 1

    def _diagnosed(self, message: DiagnosticArray) -> None:
        self.reports += 1
        ours = f"{self.name.lstrip('/')}: "
        for status in message.status:
            if status.name.startswith(ours):
                self._values |= {pair.key: pair.value for pair in status.values}


def frames_missing(tally: Tally) -> str:
    """The frames that did not come, in words."""
    return f"{tally.lost} of {tally.frames + tally.lost} frames missing"


def stamps_off(tally: Tally) -> str:
    """The error of the worst stamp, in words."""
    worst_s = max(tally.stamp_errors_s, key=abs, default=0.0)
    return f"stamps off by {worst_s * 1e3:.0f} ms at most"
