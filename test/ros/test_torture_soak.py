# SPDX-License-Identifier: Apache-2.0

"""The soak, slices of campaigns under load and on three computers; planted defects."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.messages.cdr import Heading
from tactile_cdma.msg import TactileArray
from tactile_cdma.ros.common import convert
from tactile_cdma.ros.common.convert import ros_array
from tactile_cdma.sim.options import SimOptions
from test.support.oracle import Held, Stream
from test.support.waiting import PATIENCE_S
from torture.hosts.campaign import run
from torture.hosts.network import why_not
from torture.load import campaign as load
from torture.load import liar, soak
from torture.load.known_digitizer import KnownDigitizer
from torture.load.loaded_skin import SOAKED, LoadedSkin
from torture.load.message_judge import MessageJudge
from torture.outcome import Plan, Tally
from torture.process_watch import Watch

CONFIG = SkinConfig.of({})
SOAK_S = 4 * soak.SHORTEST_CYCLE_S
"""Four cycles of guests that come and go; slopes of memory take longer anyway."""
FIRST, FRAMES = 100, 300
POWERED_S = 1000.0
OPTIONS = SimOptions(scene="presses")


@pytest.mark.slow
def test_some_cycles_of_the_real_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "LOOK_S", 0.1)  # enough looks for a slope on a busy machine, too
    outcome = soak.soak(SOAK_S)
    assert outcome.good, outcome
    assert "kB/h" in outcome.said
    assert " 0 pictures" not in outcome.said


def messages() -> list[TactileArray]:
    """What a sound driver publishes of a skin, from its frame FIRST on."""
    held, made = Held(CONFIG), []
    frames, lsb_v = Stream(OPTIONS, OPTIONS.setup(), 0.0), CONFIG.adc.lsb_v
    for number in range(FRAMES):
        frame = frames.frame_at(number * CONFIG.spec.frame_period_s)
        assert frame is not None
        held.hear(frame.active, frame.codes)
        if number < FIRST:
            continue
        middle_s = frame.start_s + CONFIG.spec.frame_s / 2
        made.append(
            TactileArray(
                header=convert.header(Heading(round((POWERED_S + middle_s) * 1e9), "")),
                sequence=number - 7,
                device_time_us=round(middle_s * 1e6),
                pressure=ros_array(held.pressure_pa.astype(np.float32)),
                voltage=ros_array((frame.codes * lsb_v).astype(np.float32)),
                status=ros_array((~frame.active).astype(np.uint8)),
            )
        )
    return made


def judged(damage: Callable[[list[TactileArray]], object], waited_s: float = 0.0) -> Tally:
    """What is found in these messages after they were damaged.

    waited_s: by the driver, for a processor, between each of the first 51 messages and the next.
    """
    heard, digitizer = messages(), KnownDigitizer(OPTIONS)
    digitizer.born_s = POWERED_S
    digitizer.streamed(Stream(OPTIONS, digitizer.setup, 0.0))
    judge = MessageJudge(digitizer, SOAKED.near_pa, SOAKED.flags)
    judge.ahead_s = [0.0]
    judge.waited_s = lambda: waited_s * min(51, judge.tally.frames)
    damage(heard)
    for message in heard:
        judge.take(message)
    return judge.tally


def test_sound_messages_have_no_fault() -> None:
    tally = judged(lambda heard: None)
    assert (tally.frames, tally.wrong_values, tally.lost, tally.uncounted_losses) == (200, 0, 0, 0)
    assert np.abs(tally.stamp_errors_s).max() < 1e-6


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
def test_a_false_message_is_found(damage: Callable[[TactileArray], None]) -> None:
    assert judged(lambda heard: damage(heard[50])).wrong_values == 1


def test_a_late_stamp_is_excused_by_as_much_as_the_driver_had_to_wait() -> None:
    def late(heard: list[TactileArray]) -> None:
        heard[50].header.stamp.sec += 1

    assert judged(late).wrong_values == 1
    assert judged(late, waited_s=0.4).wrong_values == 1, "20 s in all, and never so long at once"
    assert judged(late, waited_s=0.6).wrong_values == 0


def test_a_false_held_value_is_found() -> None:
    """Of a node that was silent in all frames that were lost."""

    def damage(heard: list[TactileArray]) -> None:
        silent = np.all([np.frombuffer(message.status, np.uint8) for message in heard[50:54]], 0)
        lose(heard)
        heard[50].pressure[int(np.flatnonzero(silent)[0])] += 90

    assert judged(damage).wrong_values == 1


def lose(heard: list[TactileArray]) -> None:
    del heard[50:53]


def hide(heard: list[TactileArray]) -> None:
    lose(heard)
    for message in heard[50:]:
        message.sequence -= 2


def test_lost_messages_are_told_from_hidden_losses() -> None:
    tally = judged(lose)
    assert (tally.lost, tally.uncounted_losses, tally.wrong_values) == (3, 0, 0)
    tally = judged(hide)
    assert (tally.lost, tally.uncounted_losses, tally.wrong_values) == (3, 2, 0)


def test_stamps_that_drift_are_found() -> None:
    rng = np.random.default_rng(0)
    late_s = 0.3e-3 + rng.exponential(1e-3, 10_000)
    assert abs(soak.drift(late_s)) < 0.1e-3
    drifting_s = late_s + np.linspace(0, 2.5e-3, 10_000)
    assert soak.drift(drifting_s) > soak.MOST_DRIFT_S
    tally = Tally(stamp_errors_s=drifting_s.tolist())
    assert soak.outcome_of(60.0, tally, Watch(1), "", 0, 0).wrong_values == 1


def test_a_leak_is_found() -> None:
    watch = Watch(1)
    watch.t_s = np.arange(0, 3600, 0.5).tolist()
    watch.rss_kb = [90_000 + int(t_s) for t_s in watch.t_s]
    assert soak.outcome_of(3600.0, Tally(), watch, "", 0, 0).crashes == 1
    watch.rss_kb = [90_000] * len(watch.t_s)
    watch.alone = [(16, 23)] * 100
    assert soak.outcome_of(3600.0, Tally(), watch, "", 0, 0).good
    watch.alone = [(16, 23 + number // 20) for number in range(100)]
    assert soak.outcome_of(3600.0, Tally(), watch, "", 0, 0).crashes == 1


def test_a_driver_whose_frames_stop_is_found(tmp_path: Path) -> None:
    with LoadedSkin(tmp_path, 1, 30.0, setting=SOAKED) as skin:
        assert skin.streams_on()
        skin.patience_s = 1.0
        skin.process.send_signal(signal.SIGSTOP)
        began_s = time.monotonic()
        soak.goes_on(60.0, skin, Watch(skin.process.pid))
        assert skin.hangs == 1
        assert time.monotonic() < began_s + 20


def test_a_driver_that_ends_or_does_not_is_found() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
        assert soak.ends(ended, 1.0) == (1, 0)
    stubborn = "import signal, time; signal.signal(2, signal.SIG_IGN); print(flush=True);"
    command = [sys.executable, "-c", f"{stubborn} time.sleep(60)"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as hangs:
        assert hangs.stdout is not None
        hangs.stdout.readline()
        assert soak.ends(hangs, 1.0) == (0, 1)
        hangs.kill()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as fails:
        time.sleep(0.5)
        assert soak.ends(fails, 10.0) == (1, 0)


PLAN = Plan(quick=True, seed=1)


@pytest.mark.slow
def test_a_slice_of_the_campaign_is_borne_and_a_traceback_is_found(tmp_path: Path) -> None:
    with LoadedSkin(tmp_path, PLAN.seed, PATIENCE_S) as skin:
        assert skin.streams_on()
        outcomes = [
            load._stuck(skin, PLAN),
            load._stops(skin, PLAN, Random(1)),
            load._unwritable_state(skin, PLAN),
            load._steps(skin, PLAN, Random(1)),
            skin.outcome("nothing", 1),
        ]
        assert [outcome for outcome in outcomes if not outcome.good] == []
        with (skin.folder / "driver.log").open("a") as log:
            log.write("internal error, starting again: Traceback\n")
        assert skin.outcome("a defect", 1).crashes == 2


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


@pytest.mark.slow
def test_a_body_on_three_computers_bears_loss_a_cut_and_wrong_clocks() -> None:
    if reason := why_not():
        pytest.skip(reason)
    outcomes = list(run(Plan(quick=True, seed=1)))
    assert [outcome for outcome in outcomes if not outcome.good] == []
    _, lossy, cut, clocks = outcomes
    assert lossy.times > 0
    assert (lost := re.search(r"(\d+) frames lost and counted", cut.said))
    assert int(lost[1]) > 25  # the network was cut, for more than a second
    assert clocks.times == 2
