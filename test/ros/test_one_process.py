# SPDX-License-Identifier: Apache-2.0

"""Many patches in one process, and all their taxels in one message: /body/tactile."""

import subprocess
import time
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from tactile_cdma.config.body_file import read_body
from tactile_cdma.msg import TactileArray, TactileBody, TactileContacts
from tactile_cdma.ros.body.node import BodyNode
from tactile_cdma.ros.client import SkinClient
from tactile_cdma.ros.common.qos import PICTURE, QUEUE
from tactile_cdma.ros.driver import patches as patches_module
from tactile_cdma.ros.driver.patches import PatchesNode
from test.support.programs import started
from test.support.scripts import body_commands, loaded
from test.support.skin_client import Client, node_with
from test.support.spinning import as_its_process, living, spinning
from test.support.waiting import wait_for

ROOT = Path(__file__).resolve().parents[2]
FILE = """
frame_id: torso
process: one
defaults: {parameters: {port: "sim://?scene=all&threshold=0&speed=0.5"}}
patches:
  left: {parameters: {mount_xyz_m: [1.0, 0.0, 0.0], mount_rpy_rad: [0.0, 1.5707963, 0.0]}}
  right: {parameters: {mount_xyz_m: [0.0, 2.0, 0.0]}}
  away: {parameters: {port: /dev/no_such_port, mount_xyz_m: [0.0, 0.0, 0.0]}}
  wrong: {params_file: wrong.yaml}
"""
WRONG = "/**: {ros__parameters: {nodes: 24, frame_period_ms: 16.0}}"


def test_a_patch_that_fails_takes_no_other_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patches_module, "RETRY_S", 0.3)
    (tmp_path / "body.yaml").write_text(FILE)
    (tmp_path / "wrong.yaml").write_text(WRONG)
    [patches] = read_body(tmp_path / "body.yaml").processes()
    client, names = Client(), ("left", "right", "wrong")
    arrays = {name: client.heard(TactileArray, f"/{name}/skin/tactile", QUEUE) for name in names}
    bodies = client.heard(TactileBody, "/body/tactile", QUEUE)
    told = client.heard(DiagnosticArray, "/diagnostics")

    def said() -> dict[str, str]:
        return {status.name: status.message for message in told for status in message.status}

    body = node_with(BodyNode, body_file=str(tmp_path / "body.yaml"), stale_after_s=1.0)
    (tmp_path / "wrong.yaml").write_text("nothing: [that ROS takes")  # changed since
    host, turns, turns_at = PatchesNode(patches), count(), list[int]()
    host.create_timer(1e-3, lambda: next(turns))
    make = patches_module.made

    def made(patch: patches_module.Patch) -> patches_module.SkinNode:
        turns_at.append(next(turns))
        return make(patch)

    monkeypatch.setattr(patches_module, "made", made)
    with as_its_process(host), as_its_process(body), spinning([client]):
        wait_for(lambda: len(arrays["left"]) > 30 and len(arrays["right"]) > 30)
        wait_for(lambda: "wrong/skin: process" in said())
        assert min(np.diff(turns_at[:4])) > 1, "others have their turn between two that are made"
        wait_for(lambda: "no such port" in said().get("away/skin: stream", ""))
        assert "wrong.yaml" in said()["wrong/skin: process"]

        left = next(node for node in host._nodes if node.get_namespace() == "/left")
        fails = [RuntimeError("planted")] * 3

        def fail(frame: Any) -> None:
            if fails:
                raise fails.pop()
            left._frames.publish(frame)

        assert left._driver is not None
        left._driver._on_frame = fail
        before = len(arrays["right"])
        wait_for(lambda: not fails)
        after = len(arrays["left"])
        wait_for(lambda: len(arrays["left"]) > after + 5)  # starts again
        assert len(arrays["right"]) > before
        assert set(np.diff([m.sequence for m in arrays["right"]])) == {1}, "no gap"

        left.pictures._publishers = None  # looking for subscribers fails
        images = client.heard(Image, "/right/skin/heatmap", PICTURE)
        wait_for(lambda: len(images) > 3)

        (tmp_path / "mended.yaml").write_text(WRONG)
        (tmp_path / "mended.yaml").rename(tmp_path / "wrong.yaml")  # whole: it is read all the time
        wait_for(lambda: arrays["wrong"])
        wait_for(lambda: bodies and bodies[-1].absent == ["/away/skin"])
        wait_for(lambda: "/wrong/skin" in bodies[-1].patches and len(bodies[-1].pressure) == 56)
        message = bodies[-1]
        assert SkinClient(client, "/left/skin").change("deactivate")
        wait_for(lambda: "/left/skin" in bodies[-1].absent)
        silent = bodies[-1]
        left._mount = None  # its end fails
        ending = patches_module.SkinNode.destroy_node

        def destroyed(node: patches_module.SkinNode) -> None:
            """What takes DDS long comes when no digitizer needs to be stopped any more."""
            streaming.append(sum(each._driver is not None for each in host._nodes))
            ending(node)

        streaming: list[int] = []
        monkeypatch.setattr(patches_module.SkinNode, "destroy_node", destroyed)
    assert streaming == [0] * 4
    assert np.isnan(silent.pressure[:16]).all() and np.isfinite(silent.pressure[16:]).all()
    assert set(silent.status[:16]) == {TactileArray.STATUS_STALE}
    assert message.header.frame_id == "torso"
    assert list(message.first) == [0, 16, 32]
    places = np.array([(p.x, p.y, p.z) for p in message.positions])
    normals = np.array([(p.x, p.y, p.z) for p in message.normals])
    pressure, status = np.array(message.pressure), np.array(message.status)
    # A grid of 7 mm about the origin: turned about y by 90°, its x points down, and z to the front.
    assert places[0] == pytest.approx([1.0, 0.0105, 0.0105], abs=1e-5)
    assert normals[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-5)
    assert places[16] == pytest.approx([-0.0105, 2.0105, 0.0], abs=1e-5)
    assert np.isnan(places[32:]).all() and np.isnan(normals[32:]).all(), "hangs from no frame"
    assert pressure.max() > 1e3 and np.isfinite(pressure).all() and not status.any()
    assert message.area[0] == pytest.approx(7e-3**2)


def test_make_run_starts_a_process_for_those_that_share_one(tmp_path: Path) -> None:
    (tmp_path / "body.yaml").write_text("process: {arm: [b, c]}\npatches: {a: {}, b: {}, c: {}}")
    arm, a, body = body_commands(tmp_path / "body.yaml")
    assert arm[1:] == [
        str(ROOT / "scripts/skin_patches"),
        str(tmp_path / "body.yaml"),
        "--only",
        "b,c",
    ]
    assert "__ns:=/a" in a and body[1].endswith("skin_body")
    for words, said in (
        ((str(tmp_path / "no.yaml"),), "no.yaml: No such file or directory"),
        ((str(tmp_path / "body.yaml"), "--only", "d"), "no patch 'd' to start"),
        (("package://my_arm/body.yaml",), "no package 'my_arm' in AMENT_PREFIX_PATH"),
    ):
        answer = subprocess.run([*arm[:2], *words], capture_output=True, text=True)
        assert answer.returncode == 1 and said in answer.stderr


ROBOT = """
process: {one: [left, right]}
stale_after_s: 2.0
defaults: {parameters: {port: "sim://?scene=idle&heartbeat=5"}}
patches:
  left: {parameters: {mount_xyz_m: [1.0, 0.0, 0.0]}}
  right: {parameters: {mount_xyz_m: [0.0, 2.0, 0.0]}}
  back: {parameters: {port: "sim://?scene=press&heartbeat=5", mount_xyz_m: [0.0, 0.0, 3.0]}}
"""


def test_two_robots_of_one_body_file_know_nothing_of_each_other(tmp_path: Path) -> None:
    """Each has three processes in a namespace; one robot loses a patch."""
    path = tmp_path / "body.yaml"
    path.write_text(ROBOT)
    for given, stale_after_s in (({}, 2.0), ({"stale_after_s": 0.9}, 0.9)):
        with living(node_with(BodyNode, body_file=str(path), **given)) as node:
            assert node.patches.values["stale_after_s"] == stale_after_s
    run, heard = loaded(ROOT / "tools" / "run.py"), dict[str, list[Any]]()
    with ExitStack() as ends:
        client = Node("client")
        ends.enter_context(spinning([client]))
        for robot in ("r1", "r2"):
            topic, heard[robot] = f"/{robot}/body/contacts", list[Any]()
            client.create_subscription(TactileContacts, topic, heard[robot].append, 100)
            within = "--ros-args", "-r", f"__ns:=/{robot}"
            many = run.script("skin_patches", str(path), "--only", "left,right", *within)
            ends.enter_context(started(many))
            body = run.script("skin_body", *within, "-p", f"body_file:={path}")
            ends.enter_context(started(body))
            command = run.patch_command(read_body(path, robot).patches[2])
            back = ends.enter_context(started(command))

        def whole(robot: str) -> bool:
            newest = heard[robot][-1]
            patches = {contact.patch for contact in newest.contacts}
            return newest.absent == [] and patches == {f"/{robot}/back/skin"}

        wait_for(lambda: whole("r1") and whole("r2"))
        assert [messages[-1].header.frame_id for messages in heard.values()] == [
            "r1/body",
            "r2/body",
        ]
        assert heard["r2"][-1].contacts[0].position.z == pytest.approx(3.0)
        back.kill()
        killed_s, begin = time.monotonic(), len(heard["r1"])
        wait_for(lambda: heard["r2"][-1].absent == ["/r2/back/skin"])
        assert time.monotonic() - killed_s > 1.5
        assert not any(message.absent for message in heard["r1"][begin:])
        wait_for(lambda: whole("r1"))  # a frame that its busy computer loses may hide the contact
