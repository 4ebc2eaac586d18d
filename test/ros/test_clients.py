# SPDX-License-Identifier: Apache-2.0

"""The ROS programs of examples/ and docs/programs.md, run beside a real driver."""

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64

from tactile_cdma.msg import SimObjects, TactileArray
from tactile_cdma.ros.common.qos import LATCHED
from tactile_cdma.ros.driver.objects import sim_objects
from tactile_cdma.sim import Box, Sphere
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from test.support.programs import run_python, started
from test.support.scripts import body_commands
from test.support.skin_client import Client, running, wait_sending
from test.support.spinning import living
from test.support.waiting import wait_for

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
OF_DDS = re.compile(r"^.*RTPS_TRANSPORT_SHM.*\n", re.MULTILINE)
"""What Fast DDS itself prints to stdout where two participants open a port in /dev/shm at once."""
TOLERANCE_NS = 20_000_000
"""What fuse_joint_states says that it leaves out."""


@contextmanager
def example(name: str, *arguments: str) -> Iterator[IO[str]]:
    """An example in a process of its own; yields what it prints, readable at any time."""
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments]
    with (
        TemporaryFile("w+") as output,
        started(command, stdout=output, stderr=subprocess.STDOUT) as process,
    ):
        yield output
        assert process.poll() is None, text_of(output)


def text_of(output: IO[str]) -> str:
    """What was printed so far, but for a line that is not complete."""
    text = os.pread(output.fileno(), 1 << 24, 0).decode()
    return OF_DDS.sub("", text[: text.rfind("\n") + 1])


class GrippedThing:
    """Something soft between the fingers; it slides while it is loaded by more than friction holds.

    A scene of the simulator: the pressure is what the gripper's command makes of it. It is so soft
    that a gripper that hears of a frame a hundred frames late overshoots by 5 kPa.
    """

    CONTACT_MM, PA_PER_MM, MOST_M = 0.3, 5e3, 0.01

    def __init__(self) -> None:
        self.closed_mm = 0.0
        self.needed_pa = 0.0  # below that the thing slides
        self.centre_m, self.speed_m_s, self._t_s = -0.004, 0.02, 0.0

    @property
    def peak_pa(self) -> float:
        return max(0.0, (self.closed_mm - self.CONTACT_MM) * self.PA_PER_MM)

    @property
    def slides(self) -> bool:
        return 0.0 < self.peak_pa < self.needed_pa

    def __call__(self, t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
        if self.slides:
            self.centre_m += self.speed_m_s * (t_s - self._t_s)
            if abs(self.centre_m) > self.MOST_M:  # and back, for the skin is small
                self.speed_m_s = math.copysign(self.speed_m_s, -self.centre_m)
        self._t_s = t_s
        away = np.hypot(skin.positions_m[:, 0] - self.centre_m, skin.positions_m[:, 1])
        return self.peak_pa * np.clip(1 - (away / (2.5 * skin.pitch_m)) ** 2, 0, None) ** 1.5


class Gripper:
    """What the program "grip" tells the fingers."""

    def __init__(self, client: Client) -> None:
        self.closed_mm: list[float] = []
        self.stops: list[bool] = []
        self.claims: list[bool] = []
        closed = ("/gripper/close_mm", Float64, self.closed_mm)
        stops, claims = ("/arm/stop", Bool, self.stops), ("/gripper/gripped", Bool, self.claims)
        for topic, kind, heard in (closed, stops, claims):
            client.create_subscription(kind, topic, lambda m, to=heard: to.append(m.data), 10)


def test_grip_closes_until_5_kpa_holds_and_stops_what_slides(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    thing = GrippedThing()
    monkeypatch.setitem(SCENES, "hand", thing)

    def close(message: Float64) -> None:
        thing.closed_mm = message.data

    def held(frames: int) -> bool:
        return len(set(told.closed_mm[-frames:])) == 1 and len(told.closed_mm) > frames

    port = "sim://?scene=hand&seed=1&threshold=1"
    with running(port=port, nodes=64, chip_us=10.0) as (_, client):
        client.create_subscription(Float64, "/gripper/close_mm", close, 10)
        told = Gripper(client)
        with example("grip"):
            wait_for(lambda: told.stops and not told.stops[-1])
            feeling = len(told.stops)
            # the taxel nearest to the peak reads a bit less than it
            wait_for(lambda: thing.peak_pa >= 5e3 and held(40))
            assert thing.peak_pa < 10e3
            assert not any(told.stops[feeling:])
            wait_for(lambda: told.claims[-1])

            grip_mm, before = told.closed_mm[-1], len(told.stops)
            thing.needed_pa = thing.peak_pa + 1e3  # somebody pulls
            wait_for(lambda: not thing.slides and held(40))
            assert any(told.stops[before:])
            assert not told.stops[-1]
            assert told.closed_mm[-1] > grip_mm
            assert thing.peak_pa >= thing.needed_pa
    assert np.all(np.diff(told.closed_mm) >= 0)


NODES = 16
ALL_DEAD = ",".join(str(node) for node in range(1, NODES + 1))
WAITED = "waiting for /skin/tare …\nwaiting until nothing touches the skin …\n"
MOST_MM = float(re.findall(r"MOST_MM, .* = ([\d.]+),", (EXAMPLES / "grip.py").read_text())[0])


PERIOD_S, STEP_MM = 12.8e-3, 0.01
"""A frame, and by how much the fingers close with each."""


def test_grip_stops_within_stale_after_s_once_all_nodes_have_died() -> None:
    """A link that works and frames that go on, of nodes that spoke in every frame and then die."""
    dead_after_s, stale_after_s = 4.0, 1.0
    port = f"sim://?scene=idle&threshold=0&dead={ALL_DEAD}&dead_after={dead_after_s}"
    with example("grip"):
        with living(rclpy.create_node("observer")) as observer:
            wait_for(lambda: observer.count_subscribers("/skin/contacts"))
        with running(port=port, stale_after_s=stale_after_s) as (_, client):
            gripper = Gripper(client)
            wait_for(lambda: len(set(gripper.closed_mm)) > 30)
            wait_for(lambda: min(client.arrays[-1].status) & TactileArray.STATUS_SILENT)
            assert len(set(gripper.closed_mm[-20:])) > 1, "it is closing when they die"
            wait_for(lambda: gripper.stops[-1])
            frames, closed_mm = len(client.arrays), gripper.closed_mm[-1]
            wait_for(lambda: len(client.arrays) > frames + 80)
    assert gripper.closed_mm[-1] - closed_mm < 0.1, "what was on its way"
    # It closes by a step a frame, so its way tells the time, on a busy computer too.
    most_frames = (dead_after_s + stale_after_s + 0.5) / PERIOD_S
    assert gripper.closed_mm[-1] < STEP_MM * most_frames
    assert gripper.closed_mm[-1] < 0.9 * MOST_MM, "the limit of travel has no part in it"
    assert gripper.stops[-1]
    assert not any(gripper.claims)


WAITING = "waiting for /skin/info and /skin/tactile …"


@pytest.mark.parametrize("dead", [ALL_DEAD, "6"])
def test_with_nodes_that_were_never_heard_grip_never_closes_and_no_force_is_printed(
    dead: str,
) -> None:
    with (
        running(port=f"sim://?scene=press&dead={dead}") as (_, client),
        example("grip"),
        example("taxel_map") as output,
    ):
        gripper = Gripper(client)
        wait_for(lambda: len(gripper.stops) > 4 / 0.0128)  # a press on and off
        wait_for(lambda: len(text_of(output).splitlines()) > 100)
        lines = text_of(output).splitlines()
    assert set(gripper.closed_mm) == {0.0}
    assert all(gripper.stops)
    assert gripper.claims
    assert not any(gripper.claims)
    unread = " ".join(str(int(node) - 1) for node in dead.split(","))
    assert lines[-1] == f"unknown: no reading of the taxels {unread}"
    assert {line.partition(":")[0] for line in lines} == {WAITING, "unknown"}


def test_grip_stops_at_its_limit_of_travel_and_without_messages() -> None:
    with running(port="sim://?scene=idle&threshold=0") as (_, client), example("grip"):
        gripper = Gripper(client)
        wait_for(lambda: gripper.stops and not gripper.stops[-1])
        wait_for(lambda: gripper.stops[-1] and gripper.closed_mm[-1] == MOST_MM)
        told = len(gripper.stops)
        assert client.change("deactivate")
        frames = len(client.arrays)
        wait_for(lambda: len(gripper.stops) > told + 5)
        assert len(client.arrays) < frames + 5, "no frames any more"
        assert all(gripper.stops[told:])
    assert max(gripper.closed_mm) == MOST_MM


def test_fusion_pairs_each_frame_with_the_joint_state_nearest_in_time() -> None:
    """Joint states of irregular pace, with pauses for which frames must be left out."""
    rng = np.random.default_rng(5)
    sent_ns: list[int] = []
    with running() as (node, client), example("fuse_joint_states") as output:
        joints = client.create_publisher(JointState, "/joint_states", 10)
        wait_for(lambda: joints.get_subscription_count() and len(client.arrays) > 10)
        while len(pairs(output)) < 100:
            assert len(sent_ns) < 2000, "no pairs"
            message = JointState(position=[float(len(sent_ns))])
            message.header.stamp = node.get_clock().now().to_msg()
            sent_ns.append(Time.from_msg(message.header.stamp).nanoseconds)
            joints.publish(message)
            time.sleep(rng.choice([0.003, 0.008, 0.1], p=[0.45, 0.45, 0.1]))
        frames_ns = np.array([Time.from_msg(m.header.stamp).nanoseconds for m in client.arrays])
        found = pairs(output)

    joints_ns = np.array(sent_ns)
    paired_ns = np.array([frame_ns for frame_ns, *_ in found])
    assert np.all(np.diff(paired_ns) > 0)
    for frame_ns, joint_ns, number in found:
        nearest = int(np.argmin(np.abs(joints_ns - frame_ns)))
        assert (joint_ns, number) == (sent_ns[nearest], nearest)
        assert abs(joint_ns - frame_ns) <= TOLERANCE_NS
    span = (frames_ns >= paired_ns[0]) & (frames_ns <= paired_ns[-1])
    distance = np.abs(frames_ns[span][:, None] - joints_ns).min(axis=1)
    assert np.any(distance > TOLERANCE_NS)
    # best effort: neither subscriber need have heard all
    assert np.isin(frames_ns[span][distance <= TOLERANCE_NS], paired_ns).mean() > 0.9


def pairs(output: IO[str]) -> list[tuple[int, int, int]]:
    """(stamp of the frame, stamp of the joint state, ns, number of the joint state)."""
    lines = [line.split() for line in text_of(output).splitlines() if line[:1].isdigit()]
    return [(int(frame), int(joint), int(float(number))) for frame, joint, _, number in lines]


def test_taxel_map_gives_force_and_centre_of_the_wrench() -> None:
    with running(port="sim://?scene=moving&seed=1&threshold=0") as (_, client):
        wrenches = client.heard(WrenchStamped, "/skin/wrench")
        with example("taxel_map") as output:
            wait_for(lambda: len(forces_and_centres(output)) > 30)
            printed = forces_and_centres(output)
            wait_for(lambda: len(wrenches) > 30)
    expected = []
    for force, torque in ((w.wrench.force, w.wrench.torque) for w in list(wrenches)):
        # of a flat skin: torque = centre × force
        centre_mm = (1e3 * torque.y / -force.z, 1e3 * torque.x / force.z, 0.0)
        expected.append((force.x, force.y, force.z, *centre_mm))
    assert printed.shape[1] == 6
    agreeing = [np.abs(np.array(expected) - line).max(axis=1).min() < 0.02 for line in printed]
    assert np.mean(agreeing) > 0.5  # of the same frames; the two did not begin with the same one


def forces_and_centres(output: IO[str]) -> NDArray[np.float64]:
    """(m, 6) what was printed: N, and mm."""
    lines = [line for line in text_of(output).splitlines() if line.startswith("force")]
    numbers = [re.findall(r"-?\d+\.\d+", line) for line in lines]
    return np.array(numbers, dtype=np.float64)


def test_tare_prints_the_answer_of_the_driver() -> None:
    with running(port="sim://?scene=idle&seed=1&threshold=0") as (_, client):
        wait_for(lambda: len(client.arrays) > 120)  # a tare takes a second of rest
        while True:
            done = run_python(EXAMPLES / "tare.py")
            if "try again" not in done.stdout and "no frames arrive" not in done.stdout:
                break  # else a busy machine lost frames
    assert (done.returncode, done.stderr) == (0, "")
    assert OF_DDS.sub("", done.stdout).startswith(f"{WAITED}tared: ")


def test_tare_with_force_takes_a_load_for_the_rest() -> None:
    with running(port="sim://?scene=idle&seed=1&threshold=0&stuck=6") as (_, client):
        wait_for(lambda: len(client.arrays) > 120)
        assert client.arrays[-1].pressure[5] > 1e3  # above contact_kpa: refused without force
        done = run_python(EXAMPLES / "tare.py", "--force")
        assert "tared: " in done.stdout and "nothing touches" not in done.stdout
        wait_for(lambda: abs(client.arrays[-1].pressure[5]) < 1e3)


def test_subscribe_prints_the_hardest_pressed_taxel() -> None:
    ball = Sphere(radius_m=0.01, position_m=(-3.5e-3, 3.5e-3, 0.009))  # on node 6, taxel 5
    port = "sim://?scene=external&dead=1"
    with running(port=port) as (_, client), example("subscribe") as output:
        press = client.create_publisher(SimObjects, "/skin/sim/objects", 10)
        wait_for(lambda: press.get_subscription_count())
        pressed = [(press, sim_objects([ball]))]
        # node 1 is dead; others may be late to be heard, or lost by a busy machine
        wait_sending(pressed, lambda: [unread for _, unread in printed_of(output, 5)].count(1) > 2)
        assert np.nanargmax(client.arrays[-1].pressure) == 5
        for peak_pa, unread in printed_of(output, 5)[-2:]:
            assert peak_pa == pytest.approx(np.nanmax(client.arrays[-1].pressure), abs=1)
            assert unread >= 1
        assert client.change("deactivate")
        wait_for(lambda: text_of(output).endswith("no frame\n"))


def printed_of(output: IO[str], taxel: int) -> list[tuple[int, int]]:
    """(pressure, Pa, taxels without a reading), of lines about this taxel under load."""
    lines = re.findall(r"taxel (\d+) has (\d+) Pa, (\d+) without", text_of(output))
    return [(int(pa), int(unread)) for found, pa, unread in lines if int(found) == taxel]


def test_points_to_numpy_finds_what_is_pressed() -> None:
    box = Box(size_m=(13e-3, 6e-3, 0.01), position_m=(0, 3.5e-3, 0.004), stiffness_pa_per_m=2e7)
    port = "sim://?scene=external&dead=16"
    with running(port=port) as (_, client), example("points_to_numpy") as output:
        press = client.create_publisher(SimObjects, "/skin/sim/objects", 10)
        wait_for(lambda: press.get_subscription_count())
        pressed = [(press, sim_objects([box]))]  # two taxels of the second row, symmetrically
        wait_sending(pressed, lambda: "2 of 15 0.0 3.5 0.0" in text_of(output))
        press.publish(SimObjects())
        wait_for(lambda: text_of(output).endswith("0 of 15 0.0 0.0 0.0\n"))


def test_two_patches_adds_their_forces_and_knows_nothing_of_an_absent_one(tmp_path: Path) -> None:
    """Both look upwards; two boxes of 5 kPa on 14 × 14 mm, 0.98 N, and of 7 × 14 mm, 0.49 N."""
    path = tmp_path / "body.yaml"
    port = "'sim://?scene=external&threshold=0'"
    path.write_text(
        "patches:\n"
        f"  one: {{parameters: {{port: {port}, mount_xyz_m: [0, 0, 0]}}}}\n"
        f"  two: {{parameters: {{port: {port}, mount_xyz_m: [1, 0, 0]}}}}\n"
    )
    with ExitStack() as ends:
        drivers = [ends.enter_context(started(command)) for command in body_commands(path)]
        client = ends.enter_context(living(rclpy.create_node("client")))
        pressed = []
        for name, width_m in (("one", 14e-3), ("two", 7e-3)):
            press = client.create_publisher(SimObjects, f"/{name}/skin/sim/objects", LATCHED)
            wait_for(press.get_subscription_count)
            x_m = 0.0 if name == "one" else 3.5e-3
            box = Box(size_m=(width_m, 14e-3, 0.01), position_m=(x_m, 0, 4.5e-3))
            pressed.append((press, sim_objects([box])))
        with example("two_patches", "/one/skin", "/two/skin") as output:
            both = "/one/skin 0.0 0.0 -0.98  /two/skin 0.0 0.0 -0.49  sum 0.0 0.0 -1.46"
            wait_sending(pressed, lambda: both in text_of(output))
            # What is none of the body's is unknown, such as a misspelt name.
            with example("two_patches", "/one/skin", "/tow/skin") as other:
                alone = "/one/skin 0.0 0.0 -0.98  /tow/skin nan nan nan  sum nan nan nan"
                wait_for(lambda: alone in text_of(other))
                assert "/tow/skin 0.0" not in text_of(other)
            drivers[1].kill()
            blind = "/one/skin 0.0 0.0 -0.98  /two/skin nan nan nan  sum nan nan nan"
            wait_for(lambda: blind in text_of(output))
