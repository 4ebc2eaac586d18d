# SPDX-License-Identifier: Apache-2.0

"""The driver withstands load, and the campaign's judges find planted defects."""

import signal
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from random import Random

import pytest

from tactile_cdma.messages.cdr import Heading
from tactile_cdma.msg import TactileArray
from tactile_cdma.ros.common.convert import header, nanoseconds
from test.support.waiting import PATIENCE_S
from torture.load import campaign as load
from torture.load import liar
from torture.load.loaded_skin import LoadedSkin
from torture.load.message_judge import LATE_S
from torture.outcome import Outcome, Plan

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


def found(
    skin: LoadedSkin, monkeypatch: pytest.MonkeyPatch, damage: Callable[[TactileArray, int], bool]
) -> Outcome:
    """What comes of 12 messages; damage: changes each, by its number, or says that it is lost."""
    take, numbers = skin.judge.take, count()

    def damaged(message: TactileArray) -> None:
        if not damage(message, next(numbers)):
            take(message)

    with monkeypatch.context() as patch:
        patch.setattr(skin.judge, "take", damaged)
        skin.streams_on(12)
    skin.streams_on(1)
    return skin.outcome("damage", 1)


def nothing(message: TactileArray, number: int) -> bool:
    return False


def another_pressure(message: TactileArray, number: int) -> bool:
    message.pressure[7] += 1.0 if number == 5 else 0.0
    return False


def another_flag(message: TactileArray, number: int) -> bool:
    message.status[7] |= TactileArray.STATUS_STALE if number == 5 else 0
    return False


def untold_loss(message: TactileArray, number: int) -> bool:
    message.sequence -= number > 5
    return number == 5


@pytest.mark.parametrize(
    ("damage", "wrong", "uncounted"),
    [
        (nothing, 0, 0),
        (another_pressure, 1, 0),
        (another_flag, 1, 0),
        (untold_loss, 0, 2),  # where it is lost, and where the numbers are right again
    ],
)
def test_what_is_wrong_in_a_message_is_found(
    skin: LoadedSkin,
    monkeypatch: pytest.MonkeyPatch,
    damage: Callable[[TactileArray, int], bool],
    wrong: int,
    uncounted: int,
) -> None:
    outcome = found(skin, monkeypatch, damage)
    assert (outcome.wrong_values, outcome.uncounted_losses) == (wrong, uncounted)
    assert (outcome.crashes, outcome.hangs) == (0, 0)


def test_an_old_frame_that_is_stamped_as_a_new_one_is_found(
    skin: LoadedSkin, monkeypatch: pytest.MonkeyPatch
) -> None:
    take, kept = skin.judge.take, list[TactileArray]()
    monkeypatch.setattr(skin.judge, "take", kept.append)
    assert skin.waits_for(lambda: kept)
    kept_s, message = time.monotonic(), kept[0]
    # Either end may have to wait meanwhile, for which the judge makes allowance.
    assert skin.waits_for(lambda: time.monotonic() - kept_s > LATE_S + skin.judge.excused_s() + 0.2)
    late_s = time.monotonic() - kept_s
    later_ns = nanoseconds(message.header.stamp) + round(late_s * 1e9)
    message.header = header(Heading(later_ns, message.header.frame_id))
    take(message)
    assert skin.outcome("stamped as if it were new", 1).wrong_values == 1


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
