# SPDX-License-Identifier: Apache-2.0

"""Two minutes of the soak, in real time; and what the soak looks for is found."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from std_msgs.msg import Header

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.msg import TactileArray
from tactile_cdma.ros.common.convert import ros_array, stamp
from tactile_cdma.sim.options import SimOptions
from torture.laps import Stretch, record
from torture.process_watch import Watch
from torture.readings import Held
from torture.soak import campaign as soak
from torture.soak.judge import Judge
from torture.soak.listener import Listener

pytestmark = [pytest.mark.ros, pytest.mark.xdist_group("soak")]  # many: so they begin early
CONFIG = SkinConfig.of({})
SOAK_S = 120.0
FRAMES = 300
POWERED_S = 1000.0


def test_two_minutes_of_the_real_driver() -> None:
    outcome = soak.soak(SOAK_S)
    assert outcome.good, outcome
    assert "kB/h" in outcome.said


@pytest.fixture(scope="module")
def told() -> Stretch:
    return record(CONFIG, SimOptions(scene="presses"), 100)


def messages(told: Stretch) -> list[TactileArray]:
    """What a sound driver publishes of laps of this stretch, from the second one on."""
    held, made = Held(CONFIG), []
    lsb_v = CONFIG.adc.lsb_v
    for number in range(FRAMES):
        place = number % len(told)
        active = told.active[place]
        held.hear(active, told.codes[place])
        if number < len(told):
            continue
        middle_s = number * told.period_us * 1e-6 + CONFIG.spec.frame_s / 2
        made.append(
            TactileArray(
                header=Header(stamp=stamp(round((POWERED_S + middle_s) * 1e9))),
                sequence=number - 7,
                device_time_us=round(middle_s * 1e6),
                pressure=ros_array(held.pressure_pa.astype(np.float32)),
                voltage=ros_array((told.codes[place] * lsb_v).astype(np.float32)),
                status=ros_array((~active).astype(np.uint8)),
            )
        )
    return made


def judged(told: Stretch, damage: Callable[[list[TactileArray]], object]) -> Judge:
    heard, judge = messages(told), Judge(told, CONFIG, POWERED_S)
    damage(heard)
    for message in heard:
        judge.judge(message, ahead_ns=0)
    return judge


def test_sound_messages_have_no_fault(told: Stretch) -> None:
    judge = judged(told, lambda heard: None)
    assert (judge.received, judge.wrong, judge.lost, judge.uncounted) == (200, 0, 0, 0)
    assert np.abs(judge.errors_s).max() < 1e-6


def another_word(message: TactileArray) -> None:
    speaker = message.status.index(0)
    message.voltage[speaker] += 2 * CONFIG.adc.lsb_v * (-1 if message.voltage[speaker] > 1 else 1)


def another_pressure(message: TactileArray) -> None:
    message.pressure[5] += 90


def no_pressure(message: TactileArray) -> None:
    message.pressure[5] = float("nan")


def nobody(message: TactileArray) -> None:
    message.status = ros_array(np.ones(16, np.uint8))


def another_flag(message: TactileArray) -> None:
    message.status[2] |= TactileArray.STATUS_WEAK


def elsewhere(message: TactileArray) -> None:
    message.device_time_us += 60


@pytest.mark.parametrize(
    "damage", [another_word, another_pressure, no_pressure, nobody, another_flag, elsewhere]
)
def test_a_false_message_is_found(damage: Callable[[TactileArray], None], told: Stretch) -> None:
    assert judged(told, lambda heard: damage(heard[50])).wrong == 1


def lose(heard: list[TactileArray]) -> None:
    del heard[50:53]


def hide(heard: list[TactileArray]) -> None:
    lose(heard)
    for message in heard[50:]:
        message.sequence -= 2


def test_lost_messages_are_told_from_hidden_losses(told: Stretch) -> None:
    judge = judged(told, lose)
    assert (judge.lost, judge.uncounted, judge.wrong) == (3, 0, 0)
    judge = judged(told, hide)
    assert (judge.lost, judge.uncounted, judge.wrong) == (3, 2, 0)


def test_stamps_that_drift_are_found(told: Stretch) -> None:
    rng = np.random.default_rng(0)
    late_s = 0.3e-3 + rng.exponential(1e-3, 10_000)
    assert abs(soak.drift(late_s)) < 0.1e-3
    assert soak.drift(late_s + np.linspace(0, 2.5e-3, 10_000)) > soak.MOST_DRIFT_S
    judge = judged(told, lambda heard: None)
    judge.errors_s = (late_s + np.linspace(0, 2.5e-3, 10_000)).tolist()
    assert soak.outcome_of(60.0, judge, Watch(1), "", 0, 0).wrong_values == 1


def test_a_leak_is_found(told: Stretch) -> None:
    judge, watch = judged(told, lambda heard: None), Watch(1)
    watch.t_s = np.arange(0, 3600, 0.5).tolist()
    watch.rss_kb = [90_000 + int(t_s) for t_s in watch.t_s]
    assert soak.outcome_of(3600.0, judge, watch, "", 0, 0).crashes == 1
    watch.rss_kb = [90_000] * len(watch.t_s)
    watch.alone = [(16, 23)] * 100
    assert soak.outcome_of(3600.0, judge, watch, "", 0, 0).good
    watch.alone = [(16, 23 + number // 20) for number in range(100)]
    assert soak.outcome_of(3600.0, judge, watch, "", 0, 0).crashes == 1


def test_a_driver_that_ends_or_hangs_is_found(
    told: Stretch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "PATIENCE_S", 1.0)
    judge, stubborn = judged(told, lambda heard: None), "import signal, time; print(flush=True);"
    stubborn = f"import signal; signal.signal(2, signal.SIG_IGN); {stubborn} time.sleep(60)"
    with Listener("/nobody") as listener:
        with subprocess.Popen([sys.executable, "-c", ""]) as ended:
            ended.wait()
            watch = Watch(ended.pid)
            assert not soak.begins(listener, ended)
            assert not soak.goes_on(5.0, listener, ended, judge, watch, tmp_path)
            assert soak.ends(ended) == (1, 0)
        command = [sys.executable, "-c", stubborn]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as hangs:
            assert hangs.stdout is not None
            hangs.stdout.readline()
            began_s = time.monotonic()
            assert not soak.begins(listener, hangs)
            assert not soak.goes_on(30.0, listener, hangs, judge, Watch(hangs.pid), tmp_path)
            assert time.monotonic() < began_s + 20
            assert soak.ends(hangs) == (0, 1)
            hangs.kill()
