# SPDX-License-Identifier: Apache-2.0

"""What a policy gets from topics is what a bag of them exports, of now, or it is told why not."""

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from tactile_cdma import ObservationError, ParameterError, PortError
from tactile_cdma.commands.cli import main
from tactile_cdma.messages.cdr import read_array
from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo
from tactile_cdma.ros.common.background import Background
from tactile_cdma.ros.common.qos import LATCHED, QUEUE
from tactile_cdma.ros.observation import TopicObservation
from test.support.bags import BagMaker
from test.support.impostor import Impostor, impostor
from test.support.programs import started
from test.support.scripts import loaded
from test.support.skin_client import running
from test.support.spinning import living, spinning
from test.support.waiting import PATIENCE_S, wait_for

OF_SKIN = (
    (TactileSkinInfo, "info", LATCHED),
    (TactileArray, "tactile", QUEUE),
    (TactileContacts, "contacts", QUEUE),
    (WrenchStamped, "wrench", QUEUE),
)
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "record_episodes.py"
STEP_NS = 100_000_000
TOUCH, SKIN = "observation.tactile.other", "observation.tactile.skin"


class Recorder(Node):
    """Records a skin's topics and /joint_states, which it publishes, as `ros2 bag record` does."""

    def __init__(self) -> None:
        super().__init__("recorder")
        self.bag, self.last_ns = BagMaker(), 0
        topics = [(kind, f"/skin/{name}", qos) for kind, name, qos in OF_SKIN]
        for kind, topic, qos in (*topics, (JointState, "/joint_states", QUEUE)):
            name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"

            def take(message: bytes, topic: str = topic, name: str = name) -> None:
                self.bag.messages.append((time.time_ns(), topic, name, message))

            self.create_subscription(kind, topic, take, qos, raw=True)
        self._joints = self.create_publisher(JointState, "/joint_states", 10)

    def move(self) -> int:
        """Publish joints of 0.1 s after the last ones, once it is then; returns the stamp, ns."""
        self.last_ns = max(self.last_ns + STEP_NS, time.time_ns() // STEP_NS * STEP_NS)
        while time.time_ns() < self.last_ns:
            time.sleep(0.002)
        seconds, nanoseconds = divmod(self.last_ns, 10**9)
        message = JointState(name=["elbow", "wrist"], position=[nanoseconds * 1e-9, 2.0])
        message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
        self._joints.publish(message)
        return self.last_ns

    def is_in_time(self, stamp_ns: int) -> bool:
        """Whether this busy machine had a frame of then, and all before it, where they are wanted.

        What comes later than 0.5 s is of now for nobody, but in a bag.
        """
        arrays = [one for one in self.bag.messages if one[1] == "/skin/tactile"][-80:]
        passed = [(seen_ns, read_array(data).heading.stamp_ns) for seen_ns, *_, data in arrays]
        is_late = any(seen_ns - its_ns > STEP_NS for seen_ns, its_ns in passed)
        return not is_late and bool(passed) and passed[-1][1] > stamp_ns

    def begin(self) -> None:
        """Forget what was recorded, but for the info, which is published once."""
        infos = [one for one in self.bag.messages if one[1] == "/skin/info"]
        self.bag.messages[:] = [(time.time_ns(), *one[1:]) for one in infos]

    def export(self, folder: Path) -> Path:
        """A dataset with a row at the stamps of /joint_states."""
        bag = self.bag.write(folder.with_suffix(".bag"))
        clock = ["--clock", "/joint_states", "--state", "/joint_states:wrist,elbow"]
        assert main(["export", str(bag), "--lerobot", str(folder), *clock]) == 0
        return folder


def rows_of(dataset: Path) -> dict[int, dict[str, Any]]:
    table = pyarrow.parquet.read_table(dataset / "data/chunk-000/file-000.parquet")
    return {row["unix_time_ns"]: row for row in table.to_pylist()}


def test_live_and_recorded_values_are_equal(tmp_path: Path) -> None:
    """Bit for bit, at the same moments; the bag is written and read by other code than ours."""
    with running(port="sim://?scene=all&seed=3&threshold=0") as _:
        recorder = Recorder()
        with spinning([recorder]):
            wait_for(lambda: len(recorder.bag.of("/skin/wrench")) > 20)
            recorder.begin()
            for _ in range(15):
                recorder.move()
            dataset = recorder.export(tmp_path / "first")
            with TopicObservation(dataset) as observation:
                found = list[dict[str, Any]]()
                wait_for(lambda: recorder.move() and _observes(observation))
                recorder.begin()
                end_s = time.monotonic() + PATIENCE_S / 2
                while len(found) < 12 and time.monotonic() < end_s:
                    stamp_ns = recorder.move()
                    time.sleep(0.06)  # until all that was measured before has come
                    if recorder.is_in_time(stamp_ns):
                        early = observation.at(stamp_ns)
                        time.sleep(0.02)
                        seen_then = observation.at(stamp_ns)
                        has_all = np.array_equal(early[SKIN], seen_then[SKIN])
                        # What is held from before the bag, only the live one knows.
                        is_whole = has_all and seen_then[f"{SKIN}.valid"].all()
                        found += [seen_then] if is_whole else []
                assert observation.notes == []
        rows = rows_of(recorder.export(tmp_path / "second"))
    for observed in found:
        row = rows[int(observed["unix_time_ns"][0])]
        assert observed.keys() == {n for n in row if n.startswith(("observation.", "unix_"))}
        for name, array in observed.items():
            expected = np.array(row[name], dtype=array.dtype).reshape(array.shape)
            assert array.tobytes() == expected.tobytes(), name
    assert len(found) == 12 and found[-1][SKIN].max() > 1e3


def test_episodes_of_topics_lead_to_them_in_one_line(tmp_path: Path) -> None:
    """Recorded without LeRobot, and without the port, which the driver has."""
    example, folder = loaded(EXAMPLE), tmp_path / "grasps"
    with running(port="sim://?scene=all&seed=3&threshold=0"):
        with TopicObservation.of({"palm": "/skin"}, contacts=True) as observation:
            wait_for(lambda: _observes(observation))
            with example.EpisodeRecorder(folder, observation) as recorder:
                rows = [recorder.add({"elbow": 1.0}, {"elbow": i / 10}) for i in range(10)]
                recorder.keep("press")
        with TopicObservation(folder) as live:
            wait_for(lambda: live.state({"elbow": 1.0}) or _observes(live))
            found = live.read(now=True)
            assert live.notes == []
    assert found.keys() == rows[0].keys() - {"action"}
    assert all(found[name].shape == rows[0][name].shape for name in found)
    assert found["observation.tactile.palm"].max() > 1e3


def _observes(observation: TopicObservation) -> bool:
    with suppress(ObservationError):
        observation.read()
        return True
    return False


@contextmanager
def observed_impostor() -> Iterator[tuple[Impostor, TopicObservation]]:
    """Somebody who publishes as /other, each number as a pressure, and what is seen of that."""
    with (
        impostor() as other,
        TopicObservation.of({"other": "/other"}, contacts=True) as observation,
    ):
        both = other.arrays, other.wrenches
        wait_for(lambda: all(one.get_subscription_count() for one in both))
        yield other, observation


def seen(observation: TopicObservation) -> tuple[float, bool, bool]:
    """The pressure of its taxel, and whether that and its wrench are valid."""
    with suppress(ObservationError):
        found = observation.read(now=True)
        valid = (found[f"observation.{kind}.other.valid"].all() for kind in ("tactile", "wrench"))
        return float(found[TOUCH][0]), *map(bool, valid)
    return math.nan, False, False


def test_what_is_not_of_now_is_not_shown() -> None:
    """By stamps, however lately it came."""
    with observed_impostor() as (other, observation):

        def send(numbers: Iterable[int], *how: float) -> None:
            for number in numbers:
                other.send(number, *how)
                time.sleep(0.02)

        send(range(100, 110), 5.0)
        send(range(110, 120), 0.0, math.inf)  # of now, perhaps
        with pytest.raises(ObservationError, match=r"tactile.other had not begun"):
            observation.read()

        def send_until_shown(first: int) -> int:
            send(range(first, first + 20))
            for number in range(first + 20, first + 1000):  # until the reader keeps up
                send([number])
                if seen(observation) == (number, True, True):
                    return number
            raise AssertionError(f"{seen(observation)} of {number}")

        last = send_until_shown(200)
        send(range(last + 1, last + 41), 5.0)
        assert seen(observation) == (last, False, False), "and it stays the last that was felt"
        last = send_until_shown(2000)
        send([last] * 40)  # again, with a new stamp
        assert seen(observation)[:2] == (last, False)


def test_two_drivers_of_one_name_are_told() -> None:
    with observed_impostor() as (other, observation):
        first, second = (
            other.arrays,
            other.node.create_publisher(TactileArray, "/other/tactile", 10),
        )
        wait_for(lambda: other.node.count_publishers("/other/tactile") == 2)
        wait_for(second.get_subscription_count)
        refused = 0
        for number in range(100, 150):
            other.arrays = (first, second)[number % 2]
            other.send(number)
            time.sleep(0.02)
            with suppress(ObservationError):
                observation.read()
                refused -= number > 110
            refused += 1
        with pytest.raises(ObservationError, match="2 drivers publish /other/tactile"):
            observation.read()
        assert refused >= 40
        other.arrays = first
        other.node.destroy_publisher(second)
        other.send(500)
        wait_for(lambda: other.send(round(time.monotonic() * 1e3)) or _observes(observation))


def test_another_skin_or_driver_is_refused(tmp_path: Path) -> None:
    maker = BagMaker().skin("/left/skin", 1.0)
    folder, bag = tmp_path / "set", maker.write(tmp_path / "bag")
    assert main(["export", str(bag), "--lerobot", str(folder), "--fps", "20"]) == 0
    with pytest.raises(ParameterError, match="unknown patch 'right'"):
        TopicObservation(folder, {"right": "/right/skin"})
    about = folder / "meta/tactile.json"
    about.write_text(about.read_text().replace('"topic"', '"path"'))
    with pytest.raises(ParameterError, match=r"drivers has no left, and .* does not name it"):
        TopicObservation(folder)
    with pytest.raises(PortError, match="no ~/info of /nobody: do these drivers run"):
        TopicObservation.of({"a": "/nobody"}, wait_s=0.3)
    closed = TopicObservation(folder, {"left": "/other"})
    with pytest.raises(PortError, match="closed"):
        closed.read()
    with impostor() as other, TopicObservation(folder, {"left": "/other"}) as observation:
        wait_for(other.arrays.get_subscription_count)
        reason = ""
        while "left has 4 × 4 taxels, in the skin 1 × 1" not in reason:
            other.send(round(time.monotonic() * 1e3))
            with pytest.raises(ObservationError, match=r"tactile.left had not begun") as told:
                observation.read()
            reason = str(told.value)


def test_who_closes_ends_no_participant_that_others_of_the_process_have() -> None:
    """Fast DDS may hang where it ends one: the interpreter's end does, or a shutdown."""
    keeper = f"_tactile_cdma_{os.getpid()}"
    with living(rclpy.create_node("watcher")) as watcher:
        first, second = Background("first"), Background("second")
        wait_for(lambda: {"first", "second", keeper} <= set(watcher.get_node_names()))
        keepers = watcher.get_node_names().count(keeper)  # one, and those of contexts shut down
        first.close()
        second.close()
        wait_for(lambda: not {"first", "second"} & set(watcher.get_node_names()))
        assert watcher.get_node_names().count(keeper) >= keepers
        second.node.context.try_shutdown()
        third = Background("third")
        assert third.node.context.ok()
        third.close()


PROGRAM = """
import signal, sys, threading, time
import rclpy
from tactile_cdma import ObservationError, PortError
from tactile_cdma.ros.observation import TopicObservation

how = sys.argv[1]
if how == "own rclpy":
    rclpy.init()  # it handles signals, and shuts down all contexts
if how == "handler":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
observation = TopicObservation.of({"other": "/other"})
observation.open()
if how == "exits":
    sys.exit(0)
if how == "again":
    for _ in range(5):
        observation.close()
        observation.close()
        observation.open()
        observation.open()
    print("read", flush=True)
print("ready", flush=True)
try:
    while True:
        try:
            observation.read()
        except ObservationError:
            pass
        time.sleep(0.001)
except PortError as error:
    print(error, flush=True)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    observation.close()
"""


ENDS = [
    ("own rclpy", signal.SIGTERM, "over: ROS was shut down", 0),
    ("own rclpy", signal.SIGINT, "", 0),
    ("handler", signal.SIGTERM, "ready", 0),
    ("plain", signal.SIGTERM, "ready", -signal.SIGTERM),
    ("plain", signal.SIGINT, "interrupted", 0),
    ("again", signal.SIGINT, "interrupted", 0),
    ("exits", None, "", 0),
]
"""How a program is written, the signal that it gets, its last words, and the code of its end."""


def test_it_ends_in_order() -> None:
    """Amid a stream of messages: without a crash, a word of rclpy, or a wait."""
    ended = threading.Event()
    with impostor() as other, ExitStack() as ends:

        def flood() -> None:
            for number in count(1):
                if ended.wait(0.001):
                    return
                other.send(number)

        sender = threading.Thread(target=flood)
        sender.start()
        ends.callback(sender.join)
        ends.callback(ended.set)
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        commands = [[sys.executable, "-c", PROGRAM, how] for how, *_ in ENDS]
        programs = [ends.enter_context(started(command, **pipes)) for command in commands]
        for (how, number, last, code), program in zip(ENDS, programs, strict=True):
            assert program.stdout is not None
            lines = []
            if number is not None:
                lines = list(takewhile(lambda line: line != "ready\n", program.stdout))
                time.sleep(0.5)
                program.send_signal(number)
            out, err = program.communicate(timeout=60)
            assert program.returncode == code, (how, err)
            assert last in (out or lines[-1:] or "ready"), (how, out, lines)
            assert "Traceback" not in err.replace("KeyboardInterrupt", "") and "rror" not in err, (
                err
            )
