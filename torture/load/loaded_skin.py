# SPDX-License-Identifier: Apache-2.0

"""A driver in a process of its own, to be put under load, and a subscriber who knows the truth."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from types import TracebackType

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from tactile_cdma.msg import TactileArray
from tactile_cdma.sim.options import SimOptions

from ..outcome import Outcome
from ..process_watch import memory_kb
from .known_digitizer import KnownDigitizer, on_a_socket, on_a_tty
from .message_judge import MessageJudge, Tally

SCENE = "sim://?scene=hand&threshold=0&seed={}"
DEFECTS = ("Traceback", "internal error")
"""What a driver's log must not hold."""
DOMAINS = 101
FRESH_S = 0.5
"""Messages that are no older come as they should, on a busy computer."""
QUEUE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
_TURN_S = 0.02
_NUMBERS = count()


class LoadedSkin:
    """Use as a context manager. patience_s: without progress for so long, something hangs.

    folder: for whatever there is to write; state_folder: the driver's.
    judge: takes every message. warned: what /diagnostics said at WARN or worse, by entry.
    """

    def __init__(
        self,
        folder: Path,
        seed: int,
        patience_s: float,
        networked: bool = False,
    ) -> None:
        """networked: the digitizer is behind a socket, else behind a tty."""
        self.digitizer = KnownDigitizer(SimOptions.from_url(SCENE.format(seed)))
        self.judge = MessageJudge(self.digitizer)
        self.warned: dict[str, set[str]] = {}
        self.hangs = 0
        namespace = f"/load_{os.getpid()}_{next(_NUMBERS)}"  # others may be in the same domain
        self.name = f"{namespace}/skin"
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(1 + (os.getpid() + networked) % DOMAINS),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_HOME": str(folder / "ros"),
        }
        self.folder, self.state_folder = folder, folder / "state"
        self.patience_s, self._networked = patience_s, networked
        # Subscribers that a publisher waits for are the worse ones.
        reliability = f"qos_overrides.{self.name}/tactile.publisher.reliability"
        self._arguments = ["-r", f"__ns:={namespace}", "-p", f"{reliability}:=reliable"]
        self._values: dict[str, str] = {}
        self._log_read = 0
        self._stack = ExitStack()

    def __enter__(self) -> LoadedSkin:
        with ExitStack() as stack:
            plugged = (
                on_a_socket(self.digitizer)
                if self._networked
                else on_a_tty(self.digitizer, self.folder / "tty")
            )
            port = stack.enter_context(plugged)
            stack.enter_context(self._listening())
            self.process = stack.enter_context(self._driver(port))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    # What is done with it

    def streams_on(self, frames: int = 20) -> bool:
        """Wait until so many messages have come from now on; where they don't, it hangs."""
        wanted = self.judge.tally.received + frames
        before = -1

        def goes_on() -> bool:
            return self.judge.tally.received > before

        while before < wanted and self.waits_for(goes_on):
            before = self.judge.tally.received
        return before >= wanted

    def is_fresh(self) -> bool:
        """Wait until messages are no older than they should be; else it hangs."""

        def fresh() -> bool:
            return time.monotonic() - self.judge.last_middle_s < FRESH_S

        return self.streams_on(1) and self.waits_for(fresh)

    def is_newest(self, since_s: float) -> bool:
        """Wait for a frame that was measured after this moment, monotonic; else it hangs."""
        return self.waits_for(lambda: self.judge.last_middle_s > since_s)

    def waits_for(self, condition: Callable[[], object]) -> bool:
        """Wait for something that has to come; where it doesn't, that is a hang."""
        end_s = time.monotonic() + self.patience_s
        while not condition():
            if time.monotonic() > end_s or self.process.poll() is not None:
                self.hangs += 1
                return False
            time.sleep(_TURN_S)
        return True

    def stopped_for(self, seconds: float) -> None:
        """The driver gets no processor at all."""
        self.process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self.process.send_signal(signal.SIGCONT)

    def says(self, value: str) -> str:
        """A value of /diagnostics, the newest; empty before it came."""
        return self._values.get(value, "")

    def complains(self, entry: str, text: str) -> bool:
        """Whether an entry of /diagnostics has said so since the last outcome."""
        return any(text in message for message in self.warned.get(entry, ()))

    @property
    def rss_kb(self) -> int:
        """Memory of the driver's process."""
        return memory_kb(self.process.pid)

    def outcome(
        self, fault: str, times: int, said: str = "", uncounted: int = 0, wrong: int = 0
    ) -> Outcome:
        """What came of a fault since the last outcome; uncounted, wrong: what else was found."""
        tally, self.judge.tally = self.judge.tally, Tally()
        said = said or f"{tally.missing} of {tally.received + tally.missing} frames missing"
        hangs, self.hangs, self.warned = self.hangs, 0, {}
        log = (self.folder / "driver.log").read_text()
        crashes = sum(log[self._log_read :].count(defect) for defect in DEFECTS)
        crashes += self.process.poll() is not None
        self._log_read = len(log)
        return Outcome(
            fault,
            times,
            wrong_values=tally.wrong + wrong,
            uncounted_losses=tally.uncounted + uncounted,
            crashes=crashes,
            hangs=hangs,
            said=tally.example or said,
        )

    # How it runs

    @contextmanager
    def _driver(self, port: str) -> Iterator[subprocess.Popen[bytes]]:
        command = [
            sys.executable,
            "-m",
            "tactile_cdma.ros.driver.node",
            "--ros-args",
            *self._arguments,
        ]
        values = {"port": port, "state_folder": self.state_folder, "drift_pa_per_min": 0.0}
        for name, value in values.items():
            command += ["-p", f"{name}:={value}"]
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
        self.node.create_subscription(TactileArray, f"{self.name}/tactile", self._take, QUEUE)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(self.node)
        thread = threading.Thread(target=executor.spin)
        thread.start()
        try:
            yield
        finally:
            executor.shutdown()
            thread.join()
            self.node.destroy_node()
            rclpy.shutdown(context=context)

    def _take(self, message: TactileArray) -> None:
        self.judge.take(message)

    def _diagnosed(self, message: DiagnosticArray) -> None:
        ours = f"{self.name.lstrip('/')}: "
        for status in message.status:
            if not status.name.startswith(ours):
                continue
            self._values |= {pair.key: pair.value for pair in status.values}
            if status.level in (status.WARN, status.ERROR):
                self.warned.setdefault(status.name.removeprefix(ours), set()).add(status.message)
