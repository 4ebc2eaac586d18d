# SPDX-License-Identifier: Apache-2.0

"""The driver withstands load, and the campaign's judges find planted defects."""

import signal
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from test.support.waiting import PATIENCE_S
from torture.load import campaign as load
from torture.load import liar
from torture.load.loaded_skin import LoadedSkin
from torture.outcome import Plan

pytestmark = pytest.mark.xdist_group("torture load")
PLAN = Plan(quick=True, seed=1)


@pytest.fixture(scope="module")
def skin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoadedSkin]:
    with LoadedSkin(tmp_path_factory.mktemp("load"), PLAN.seed, PATIENCE_S) as skin:
        assert skin.streams_on()
        yield skin


def test_a_slice_of_the_campaign_is_borne(skin: LoadedSkin) -> None:
    outcomes = [
        load._stuck(skin, PLAN),
        load._stops(skin, PLAN, Random(1)),
        load._unwritable_state(skin, PLAN),
        load._steps(skin, PLAN, Random(1)),
    ]
    assert [outcome for outcome in outcomes if not outcome.good] == []


def test_a_driver_that_hangs_does_not_count_or_ends_is_found(tmp_path: Path) -> None:
    with LoadedSkin(tmp_path, PLAN.seed, PATIENCE_S) as skin:
        assert skin.streams_on()
        skin.patience_s = 1.5
        skin.digitizer.packets_dropped += 1_000_000
        outcome = skin.outcome("not counted", 1, uncounted=load._uncounted(skin))
        assert (outcome.uncounted_losses > 900_000, outcome.hangs) == (True, 1)
        skin.process.send_signal(signal.SIGSTOP)
        assert not skin.streams_on(100_000)
        assert skin.outcome("stopped for good", 1).hangs == 1
        skin.process.kill()
        skin.process.wait()
        assert not skin.streams_on(100_000)
        outcome = skin.outcome("killed", 1)
        assert (outcome.crashes, outcome.hangs) == (1, 1)


BRITTLE = """
import rclpy
from tactile_cdma.msg import TactileArray
rclpy.init()
node = rclpy.create_node("brittle")
node.create_subscription(TactileArray, "/skin/tactile", lambda m: m.pressure[15], 10)
rclpy.spin(node)
"""


def test_a_program_that_a_lie_ends_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(liar, "commands", lambda folder: {"brittle": ["-c", BRITTLE]})
    monkeypatch.setattr(liar, "TRUTH", {"/skin/tactile": liar.TRUTH["/skin/tactile"]})
    monkeypatch.setattr(liar, "SERVED", ())
    outcome = liar.lied_to(PLAN, tmp_path)
    assert (outcome.crashes, outcome.hangs, outcome.said) == (1, 0, "brittle ended")


def test_a_traceback_in_the_log_is_found(skin: LoadedSkin) -> None:
    assert skin.outcome("nothing", 1).crashes == 0
    with (skin.folder / "driver.log").open("a") as log:
        log.write("internal error, starting again: Traceback\n")
    assert skin.outcome("a defect", 1).crashes == 2
