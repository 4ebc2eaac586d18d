# SPDX-License-Identifier: Apache-2.0

"""A gripper in MuJoCo grips by touch: closes until 5 kPa, lifts, and regains a grip that slips.

A parallel gripper with a 4 × 4 skin on its left finger stands over a cylinder of 100 g. With every
frame of the skin 12.8 ms of physics pass: what touches the finger is pressed on a simulated skin
(~/sim/objects), the driver decodes it, and examples/grip.py, the program that runs beside a real
skin, answers on /gripper/close_mm, /gripper/gripped and /arm/stop. Once lifted, the cylinder is
filled to 250 g, so that it slips. No screen is needed; the pace is that of the computer.

    make example-grip            # or .venv/bin/python examples/mujoco_grip.py, with mujoco there
    make example-grip BLIND=1    # the controller has no cue for slip, and drops it
    make example-grip SPEED=max  # the same rule in one process, without ROS and without the line;
                                 # of 1 ms of CPU time per frame MuJoCo's physics take 0.3 ms

The last line: gripped=1 if the controller claims a grip at the end, lifted=1 once the cylinder was
40 mm up, dropped=1 if it fell; peak_kpa, the greatest pressure felt; reaction_ms, from the
beginning of the first slip (physics) to the first command to close further, or none.

--dead-after S lets all nodes of the skin die after S s. tools/grip_picture.py draws both runs.
"""

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
import rclpy
from grip import SLIP_M_S, Rule
from mujoco_skin import MujocoSkin
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Bool, Float64

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.msg import SimObjects, TactileContacts
from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.readings.contact import ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.ros.client import SETTLED_S
from tactile_cdma.ros.driver.objects import sim_objects
from tactile_cdma.sim import Indenter, SkinBatch

PITCH_M, FRAME_S, STEPS = 7e-3, 12.8e-3, 32  # of physics per frame
RADIUS_M, GAP_M, LIGHT_KG, HEAVY_KG = 0.020, 0.5e-3, 0.100, 0.250
LIFT_M, LIFT_M_S, FILL_KG_S = 0.060, 0.03, 0.05
UP_M, SLIPS_M_S = 0.040, 2e-3
MOST_S, HOLD_S, STOPPED_S, ANSWER_S = 25.0, 1.5, 2.0, 10.0
RUBBER = "friction='0.6 0.001 0.0001' solref='-6000 -15'"


def finger(name: str, side: int, face: str, colour: str) -> str:
    """The XML of a finger; side: -1 left, 1 right. face: name of the geom that touches."""
    return f"""
      <body name="{name}" gravcomp="1" pos="{side * (RADIUS_M + GAP_M + 0.004)} 0 0">
        <joint name="{name}" type="slide" axis="{-side} 0 0" damping="40"/>
        <geom name="{face}" type="box" size="0.004 0.014 0.014" mass="0.1" {RUBBER}
              rgba="{colour}"/>
        <geom type="box" pos="{0.006 * side} 0 0.02" size="0.002 0.008 0.034" mass="0.05"
              contype="0" conaffinity="0" rgba="0.4 0.4 0.45 1"/>
      </body>"""


MODEL = f"""
<mujoco>
  <option timestep="{FRAME_S / STEPS}" cone="elliptic" impratio="100"/>
  <asset>
    <texture type="skybox" builtin="flat" rgb1="0.93 0.94 0.95" width="8" height="8"/>
  </asset>
  <worldbody>
    <light pos="0.1 -0.4 0.5" dir="-0.2 0.7 -0.8" diffuse="0.9 0.9 0.9"/>
    <geom name="table" type="plane" size="0.2 0.2 0.01" rgba="0.75 0.75 0.72 1"/>
    <body name="hand" gravcomp="1" pos="0 0 {RADIUS_M}">
      <joint name="lift" type="slide" axis="0 0 1" damping="50"/>
      <geom type="box" pos="0 0 0.05" size="0.05 0.012 0.006" mass="0.5" rgba="0.3 0.3 0.35 1"/>
      {finger("left", -1, "skin", "0.15 0.45 0.55 1")}
      {finger("right", 1, "bare", "0.4 0.4 0.45 1")}
    </body>
    <body name="thing" pos="0 0 {RADIUS_M}">
      <freejoint/>
      <geom name="thing" type="cylinder" size="{RADIUS_M} 0.012" euler="90 0 0" mass="{LIGHT_KG}"
            {RUBBER} rgba="0.85 0.5 0.2 1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="5000"/>
    <position name="left" joint="left" kp="5000"/>
    <position name="right" joint="right" kp="5000"/>
  </actuator>
</mujoco>
"""
# In the finger's frame: x along its y, y up, z out of its face.
SKIN_POSE = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.004, 0.0, 0.0]))


Floats: TypeAlias = NDArray[np.float64]
Run: TypeAlias = tuple[str, Floats, list[Floats]]
"""The outcome, its course and the states of the physics."""


class Answer(NamedTuple):
    """What the controller says after a frame."""

    felt_pa: float
    closed_mm: float
    gripped: bool
    stop: bool


class Cell:
    """The gripper, its object and the skin on its left finger; time passes frame by frame."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)
        layout = Layout.grid(16, 4, 4, PITCH_M, PITCH_M)
        self.skin = MujocoSkin(self.model, "skin", layout, SKIN_POSE)
        self.left, self.thing = (self.model.body(name).id for name in ("left", "thing"))
        self.inertia_per_kg = self.model.body_inertia[self.thing] / LIGHT_KG
        self.mass_kg, self.lift_m = LIGHT_KG, 0.0
        mujoco.mj_forward(self.model, self.data)

    def pass_frame(self, closed_mm: float) -> None:
        self.data.ctrl[:] = self.lift_m, 1e-3 * closed_mm, 1e-3 * closed_mm
        self.model.body_mass[self.thing] = self.mass_kg
        self.model.body_inertia[self.thing] = self.mass_kg * self.inertia_per_kg
        mujoco.mj_step(self.model, self.data, STEPS)

    @property
    def height_m(self) -> float:
        return float(self.data.xpos[self.thing, 2]) - RADIUS_M

    @property
    def slid_m(self) -> float:
        """How far the thing is below the middle of the fingers."""
        return float(self.data.xpos[self.left, 2] - self.data.xpos[self.thing, 2])


class Controller:
    """examples/grip.py and a driver of a simulated skin, as processes; a frame is a question."""

    def __init__(self, node: Node, slip_m_s: float, dead_after_s: float | None) -> None:
        self.state = TemporaryDirectory()  # no tare of another simulation, nor for one
        parameters = {
            "port": port(dead_after_s),
            "stale_after_s": 0.3,
            "state_folder": self.state.name,
        }
        self.processes = [
            started("-m", "tactile_cdma.ros.driver.node", **parameters),
            started(str(Path(__file__).with_name("grip.py")), slip_m_s=slip_m_s),
        ]
        self.node = node
        self.answers: dict[str, list[Any]] = {}
        self.objects = node.create_publisher(SimObjects, "/skin/sim/objects", 10)
        for kind, topic in (
            (TactileContacts, "/skin/contacts"),
            (Float64, "/gripper/close_mm"),
            (Bool, "/gripper/gripped"),
            (Bool, "/arm/stop"),
        ):
            self.answers[topic] = []
            node.create_subscription(kind, topic, self.answers[topic].append, 10)

    def answer(self, cell: Cell) -> Answer | None:
        """What the controller says to a frame; None if it does not answer."""
        return self.ask(cell.skin.objects(cell.data), ANSWER_S)

    def ask(self, objects: Sequence[Indenter], patience_s: float) -> Answer | None:
        """Tell what the controller says to these touching the skin; None if it does not answer."""
        for answers in self.answers.values():
            answers.clear()
        self.objects.publish(sim_objects(objects))
        end_s = time.monotonic() + patience_s
        while not all(self.answers.values()):
            if time.monotonic() > end_s:
                return None
            rclpy.spin_once(self.node, timeout_sec=0.05)
        contacts, closed, gripped, stop = (answers[-1] for answers in self.answers.values())
        felt_pa = max((contact.pressure_max for contact in contacts.contacts), default=0.0)
        return Answer(felt_pa, closed.data, gripped.data, stop.data)

    def begin(self) -> None:
        """Let untouched frames pass until the controller feels the whole skin."""
        ends_s = time.monotonic() + 3 * ANSWER_S
        while time.monotonic() < ends_s:
            if any(process.poll() is not None for process in self.processes):
                raise SystemExit("mujoco_grip: the driver or the controller has ended")
            heard = self.node.count_subscribers("/skin/contacts") == 2  # by both of us
            if not (heard and self.objects.get_subscription_count()):
                rclpy.spin_once(self.node, timeout_sec=0.05)
                continue
            answer = self.ask([], patience_s=0.2)
            if answer and not answer.stop:
                return
        raise SystemExit("mujoco_grip: no answer from driver and controller")

    def close(self) -> None:
        for process in self.processes:
            process.terminate()
            process.wait()
        self.state.cleanup()


class InProcess:
    """Applies the controller's rule to what SkinBatch says a driver would publish, for training."""

    def __init__(self, slip_m_s: float, dead_after_s: float | None) -> None:
        config = SkinConfig.of({"nodes": 16, "stale_after_s": 0.3})
        self.batch = SkinBatch(config, 1, port(dead_after_s), delay_frames=0)
        self.state = self.batch.begin(np.zeros(()))
        self.tracker = ContactTracker(config.layout, config.contact)
        self.rule, self.t_s = Rule(slip_m_s), 0.0

    def answer(self, cell: Cell) -> Answer:
        pressed_pa = cell.skin.pressure_pa(cell.data)
        self.state, frame = self.batch.step(self.state, pressed_pa[None])
        self.t_s += FRAME_S
        felt_pa, status = frame.pressure_pa[0], frame.status[0]
        # Voltages are for people; contacts come of pressures.
        found = self.tracker.update(Readings(felt_pa, felt_pa, status), self.t_s)
        speeds_m_s = np.linalg.norm(found.velocity_m_s[found.age_s > SETTLED_S], axis=1)
        most_pa = float(found.pressure_max_pa.max(initial=0.0))
        sure = found.coverage.is_whole
        return Answer(most_pa, *self.rule.decide(sure, float(speeds_m_s.max(initial=0.0)), most_pa))


def port(dead_after_s: float | None) -> str:
    """The simulated skin; its nodes die after so many s."""
    url = "sim://?scene=external&speed=0&threshold=0"
    dead = ",".join(map(str, range(1, 17)))
    return url if dead_after_s is None else f"{url}&dead={dead}&dead_after={dead_after_s:g}"


def started(*command: str, **parameters: object) -> subprocess.Popen[bytes]:
    """A ROS program of this Python, as a process."""
    settings = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return subprocess.Popen([sys.executable, *command, "--ros-args", *settings])


def run(node: Node, slip_m_s: float, dead_after_s: float | None = None) -> Run:
    """Grip, lift, fill and hold; returns the outcome, its course and the states of the physics.

    The course has a row per frame: s, Pa felt, mm closed, N on the skin, m up, m slid, kg, stopped.
    """
    controller = Controller(node, slip_m_s, dead_after_s)
    try:
        controller.begin()
        return course(controller, Cell())
    finally:
        controller.close()


def course(controller: Controller | InProcess, cell: Cell) -> Run:
    closed_mm, gripped, stop = 0.0, False, True
    lifted = dropped = False
    slip_from_s, slipped_mm, reaction_s = math.inf, 0.0, math.nan
    held_s = stopped_s = 0.0
    rows: list[tuple[float, ...]] = []
    states: list[Floats] = []
    for frame in range(round(MOST_S / FRAME_S)):
        t_s, slid_m = frame * FRAME_S, cell.slid_m
        cell.pass_frame(closed_mm)
        answer = controller.answer(cell)
        if answer is None:
            gripped = False
            break
        felt_pa, closed_mm, gripped, stop = answer
        stopped_s = stopped_s + FRAME_S if stop else 0.0
        up = cell.lift_m >= LIFT_M
        if gripped and not up:
            cell.lift_m += LIFT_M_S * FRAME_S
        filling = up and cell.mass_kg < HEAVY_KG
        if filling:
            cell.mass_kg += FILL_KG_S * FRAME_S
        lifted = lifted or cell.height_m > UP_M
        dropped = dropped or (lifted and cell.slid_m > RADIUS_M)
        if t_s < slip_from_s and filling and (cell.slid_m - slid_m) / FRAME_S > SLIPS_M_S:
            slip_from_s, slipped_mm = t_s, closed_mm
        regains = t_s >= slip_from_s and closed_mm > slipped_mm and not dropped
        if regains and math.isnan(reaction_s):
            reaction_s = t_s - slip_from_s
        force_n = sum(cell.skin.forces_n(cell.data).values())
        rows.append(
            (t_s, felt_pa, closed_mm, force_n, cell.height_m, cell.slid_m, cell.mass_kg, stop)
        )
        states.append(cell.data.qpos.copy())
        held_s = held_s + FRAME_S if up and not filling and not stop else 0.0
        if held_s > HOLD_S or stopped_s > STOPPED_S or (dropped and cell.height_m < 0.01):
            break
    felt = np.array(rows)
    reaction = "none" if math.isnan(reaction_s) else f"{1e3 * reaction_s:.0f}"
    outcome = (
        f"gripped={gripped:d} lifted={lifted:d} dropped={dropped:d} "
        f"peak_kpa={1e-3 * felt[:, 1].max():.1f} reaction_ms={reaction}"
    )
    return outcome, felt, states


def main() -> None:
    parser = argparse.ArgumentParser(description="A gripper in MuJoCo that grips by touch.")
    parser.add_argument("--blind", action="store_true", help="without the cue for slip")
    parser.add_argument("--fast", action="store_true", help="in one process, without ROS")
    parser.add_argument("--dead-after", type=float, help="the skin's nodes die after so many s")
    arguments = parser.parse_args()
    slip_m_s = 1e9 if arguments.blind else SLIP_M_S
    if arguments.fast:
        controller, cell = InProcess(slip_m_s, arguments.dead_after), Cell()
        begun_s = time.process_time()
        outcome, felt, _ = course(controller, cell)
        per_cpu_s = len(felt) / (time.process_time() - begun_s)
        print(f"{outcome} frames_per_cpu_s={per_cpu_s:.0f}")
        return
    rclpy.init()
    node = rclpy.create_node("mujoco_grip")
    outcome, *_ = run(node, slip_m_s, arguments.dead_after)
    rclpy.shutdown()
    print(outcome)


if __name__ == "__main__":
    main()
