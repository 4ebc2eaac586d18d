# SPDX-License-Identifier: Apache-2.0

"""Load: subscribers of every kind, starvation, full disks, clock steps.

One driver node, behind a tty, is put through all of it in turn; another one, behind a socket, is
stopped again and again. A subscriber with the truth judges all messages of both.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import cycle, repeat
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from ..outcome import Outcome, Plan
from .liar import are_done, lied_to
from .loaded_skin import LoadedSkin, frames_missing, stamps_off
from .places import crowded, without_room
from .simulated_time import SimulatedTime

MOST_GROWTH_KB = 50_000
"""Chosen: more growth of the driver's memory than a few subscribers can explain."""
HOG = "import time; end_s = time.monotonic() + {}\nwhile time.monotonic() < end_s: pass"
"""A program that occupies a core for this many seconds."""
STARVED_NICE = 19
PATIENCE_S = 60.0
"""Time without progress that counts as a hang, s."""
AT_ONCE = 8
"""Calls of each service on their way at the same time."""
FULL_BYTES = 100_000
FRAMES = 500
"""Frames to judge while some subscribers are slow or many."""
STOPS_S = ((0.01, 0.1, 1.0), 5 * (0.01, 0.03, 0.1, 0.3, 0.7, 1.0, 2.0, 5.0) + (20.0,))
SLACK_FRAMES = 3
"""Frames that a hole may cost beyond its length: those in which it begins and ends, and the first
whole one after it, which may be the one that shows where the stream goes on."""


def run(plan: Plan) -> Iterator[Outcome]:
    """Run everything on one driver, one after the other."""
    rng = Random(plan.seed)
    with TemporaryDirectory(prefix="load-") as folder:
        with LoadedSkin(Path(folder), plan.seed, PATIENCE_S) as skin:
            skin.streams_on()
            before_kb = skin.rss_kb
            yield _stuck(skin, plan)
            yield _slow(skin, plan)
            yield _many(skin, plan)
            if not plan.quick:  # a quick run has killed subscribers, too
                yield _come_and_go(skin)
            yield _calls(skin, plan)
            yield _stops(skin, plan, rng)
            yield _unwritable_state(skin, plan)
            yield _steps(skin, plan, rng)
            yield _starved(skin, plan)
            yield _growth(skin, skin.rss_kb - before_kb)
        yield _full_recording(Path(folder), plan)
        yield lied_to(plan, Path(folder))
        yield from without_room(plan, Path(folder), PATIENCE_S)
        yield crowded(plan, Path(folder), PATIENCE_S)
    if not plan.quick:
        with (
            TemporaryDirectory(prefix="load-") as folder,
            LoadedSkin(Path(folder), plan.seed, PATIENCE_S, networked=True) as skin,
        ):
            skin.streams_on()
            yield _stops_behind_a_socket(skin, rng)


def _stuck(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Reliable keep-all subscribers are stopped by a signal, later killed."""
    count = 2 if plan.quick else 10
    with _crowd(skin, "--participants", str(count)) as crowd:
        crowd.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        skin.streams_on(60 if plan.quick else FRAMES)
        crowd.kill()
        skin.streams_on()
    return skin.outcome("subscribers that are stopped, reliable and keep-all", count)


def _slow(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Subscribers that take a second per message, of arrays and of pictures."""
    each = 1 if plan.quick else 5
    arguments = ("--each", str(each), "--delay", "1.0")
    kinds = ("pictures",) if plan.quick else ("arrays", "pictures")
    with ExitStack() as stack:
        for kind in kinds:
            stack.enter_context(_crowd(skin, *arguments, "--kind", kind))
        skin.streams_on(60 if plan.quick else FRAMES)
    return skin.outcome("subscribers that take 1 s per message", each * len(kinds))


def _many(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Tens of subscribers: each receives every message unaltered, or a gap in the sequence."""
    crowds = [(2, 4, "arrays")]
    if not plan.quick:
        crowds = [(5, 4, "arrays"), (5, 4, "arrays"), (5, 2, "pictures")]
    with ExitStack() as stack:
        running = [
            stack.enter_context(
                _crowd(skin, "--participants", str(p), "--each", str(n), "--kind", kind)
            )
            for p, n, kind in crowds
        ]
        skin.streams_on(60 if plan.quick else FRAMES)
        known = dict(skin.judge.digests)
        got = [member for crowd in running for member in _ended(crowd)]
    count = sum(p * n for p, n, _ in crowds)
    wrong = missing = total = 0
    for _, digests in got:
        sequences = [int(sequence) for sequence in digests]
        wrong += sequences != sorted(sequences)
        wrong += sum(known.get(int(s), value) != value for s, value in digests.items())
        total += len(sequences)
        missing += max(sequences) - min(sequences) + 1 - len(sequences) if sequences else 0
    said = f"{total} messages, {missing} missing by their sequence"
    return skin.outcome("many subscribers at once", count, said, len(got) != count, wrong)


def _come_and_go(skin: LoadedSkin) -> Outcome:
    """DDS participants that are killed."""
    rounds, each = 8, 4
    for _ in range(rounds):
        with _crowd(skin, "--participants", str(each)) as crowd:
            crowd.kill()
        skin.streams_on(5)
    return skin.outcome("DDS participants that come and are killed", rounds * each)


def _calls(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Call services as fast as they answer; a third of the settings must be refused."""
    settings = cycle(
        SetParameters.Request(parameters=[Parameter("visual_rate_hz", value=hz).to_parameter_msg()])
        for hz in (-1.0, 10.0, 30.0)
    )
    kinds = (
        (SetParameters, "set_parameters", settings),
        (GetParameters, "get_parameters", repeat(GetParameters.Request(names=["port", "bits"]))),
        (ListParameters, "list_parameters", repeat(ListParameters.Request())),
        (GetState, "get_state", repeat(GetState.Request())),
    )
    clients = [(skin.node.create_client(kind, f"{skin.name}/{n}"), q) for kind, n, q in kinds]
    asked = refused = 0
    skin.waits_for(lambda: all(client.service_is_ready() for client, _ in clients))
    end_s, answered = time.monotonic() + (1.0 if plan.quick else 20.0), True
    while answered and time.monotonic() < end_s:
        calls = [client.call_async(next(requests)) for client, requests in clients * AT_ONCE]
        asked += len(calls)
        answered = skin.waits_for(partial(are_done, calls))
        for answer in (call.result() for call in calls[:: len(clients)] if call.done()):
            refused += not answer.results[0].successful
    skin.streams_on()
    return skin.outcome(
        "calls of services and parameters, as fast as they are answered",
        asked,
        f"{refused} refused as they should be",
        wrong=abs(refused - asked // len(clients) // 3) > 1,
    )


def _stops(skin: LoadedSkin, plan: Plan, rng: Random) -> Outcome:
    """Stop the driver for a while: it may lose only the frames of the packets dropped meanwhile."""
    stops_s, line = list(STOPS_S[not plan.quick]), skin.digitizer
    rng.shuffle(stops_s)
    lost, holes = skin.judge.tally.lost, line.holes
    samples, left_out = line.samples_dropped, line.frames_lost
    for seconds in stops_s:
        skin.stopped_for(seconds)
        skin.is_newest(time.monotonic())
    lost = skin.judge.tally.lost - lost
    dropped_s = (line.samples_dropped - samples) / line.setup.rate_hz
    most = dropped_s / line.setup.spec.frame_period_s + line.frames_lost - left_out
    most += SLACK_FRAMES * (line.holes - holes)
    uncounted = _uncounted(skin)
    said = (
        f"{lost} frames missing, {most:.0f} at most for {dropped_s:.1f} s that found no room, "
        f"{line.packets_dropped} packets dropped and counted"
    )
    return skin.outcome(
        "the driver is stopped, 10 ms to 20 s", len(stops_s), said, uncounted, lost > most
    )


def _uncounted(skin: LoadedSkin) -> int:
    """Difference between packets the digitizer dropped and packets the driver counts as lost."""
    skin.waits_for(lambda: int(skin.says("lost packets") or -1) >= skin.digitizer.packets_dropped)
    more = int(skin.says("lost packets") or 0) - skin.digitizer.packets_dropped
    skipped = int(skin.says("skipped bytes") or 0)  # their packets count as lost, too
    return 0 if skipped and more > 0 else abs(more)


def _unwritable_state(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Make the driver's state folder unusable for a while: the service must report failure.

    A limit on file sizes would be simpler, but applies to DDS's shared memory as well, and Fast
    DDS waits forever for a segment that has not got its size.
    """
    times = 1 if plan.quick else 20
    client = skin.node.create_client(Trigger, f"{skin.name}/save_calibration")
    skin.waits_for(client.service_is_ready)

    def saves() -> bool:
        call = client.call_async(Trigger.Request())
        return bool(skin.waits_for(call.done) and call.result().success)

    wrong = int(not saves())
    for _ in range(times):
        away = skin.state_folder.rename(skin.folder / "away")
        skin.state_folder.touch()  # a file: not even root can write in it
        wrong += saves()
        skin.state_folder.unlink()
        away.rename(skin.state_folder)
        wrong += not saves()
    skin.streams_on()
    return skin.outcome("the driver's files cannot be written", times, wrong=wrong)


def _full_recording(folder: Path, plan: Plan) -> Outcome:
    """A recording exceeds a file size limit: one message, and what was written can be read."""
    times, crashes, wrong = 1 if plan.quick else 10, 0, 0
    for number in range(times):
        path, most = folder / f"{number}.skin", FULL_BYTES * (number + 1)
        # At speed 0 simulated time passes with the samples: none are lost on a busy machine.
        record = [
            sys.executable,
            "-m",
            "tactile_cdma.commands.cli",
            "record",
            "sim://?scene=moving&speed=0",
            str(path),
        ]
        done = subprocess.run(
            [*record, "--seconds", "20"],
            preexec_fn=partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most)),
            capture_output=True,
            text=True,
        )
        crashes += done.returncode != 1 or len(done.stderr.splitlines()) != 1
        info = [sys.executable, "-m", "tactile_cdma", "info", str(path)]
        told = subprocess.run(info, capture_output=True, text=True).stdout
        wrong += "lost 0, CRC errors 0" not in told or "is cut short" not in told
    return Outcome("a recording that does not fit on the disk", times, wrong, crashes=crashes)


def _starved(skin: LoadedSkin, plan: Plan) -> Outcome:
    """Starve the driver, at nice 19, by two busy programs per core."""
    seconds = 1.5 if plan.quick else 20.0
    for task in Path(f"/proc/{skin.process.pid}/task").iterdir():
        os.setpriority(os.PRIO_PROCESS, int(task.name), STARVED_NICE)
    command = [sys.executable, "-c", HOG.format(seconds)]
    hogs = [subprocess.Popen(command) for _ in range(2 * (os.cpu_count() or 1))]
    for hog in hogs:
        hog.wait()
    skin.is_fresh()
    tally, skipped = skin.judge.tally, skin.says("skipped bytes")
    said = f"{frames_missing(tally)}, {stamps_off(tally)}, {skipped} bytes skipped"
    return skin.outcome(
        "s with the driver at nice 19 and two hogs per core",
        round(seconds),
        said,
        _uncounted(skin),
    )


def _growth(skin: LoadedSkin, grown_kb: int) -> Outcome:
    """Growth of the driver's memory."""
    return skin.outcome(
        "memory of the driver after all this",
        1,
        f"{grown_kb / 1024:+.1f} MB",
        uncounted=grown_kb > MOST_GROWTH_KB,
    )


def _steps(skin: LoadedSkin, plan: Plan, rng: Random) -> Outcome:
    """Step ROS time by seconds and hours, both ways."""
    steps_s = [2.0, -2.0, 3600.0, -3600.0] if plan.quick else [2.0, -2.0, 3600.0, -3600.0] * 10
    rng.shuffle(steps_s)
    with SimulatedTime(skin) as clock:
        late = sorted(clock.step(step_s) for step_s in steps_s)
    said = f"frames with the old time: median {late[len(late) // 2]}, most {late[-1]}"
    return skin.outcome("steps of ROS time by 2 s and 1 h, either way", len(steps_s), said)


def _stops_behind_a_socket(skin: LoadedSkin, rng: Random) -> Outcome:
    """Stop the driver while the kernel buffers its input: no stale frame may get a new stamp."""
    stops_s = [0.3, 1.0, 3.0, 5.0] * 3
    rng.shuffle(stops_s)
    for seconds in stops_s:
        skin.stopped_for(seconds)
        skin.is_newest(time.monotonic())
    tally = skin.judge.tally
    said = f"{frames_missing(tally)}; {stamps_off(tally)}"
    return skin.outcome("the driver is stopped, a socket before it", len(stops_s), said)


@contextmanager
def _crowd(skin: LoadedSkin, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start subscribers in their own process, and wait for each one's first message."""
    command = [sys.executable, "-m", "torture.load.crowd", skin.name, *arguments]
    process = subprocess.Popen(command, env=skin.environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        skin.hangs += not process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def _ended(crowd: subprocess.Popen[str]) -> list[tuple[int, dict[str, int]]]:
    """End a crowd: number of messages of each subscriber, and digests by sequence."""
    crowd.terminate()
    assert crowd.stdout is not None
    return [(count, got) for count, got in json.loads(crowd.stdout.readline() or "[]")]
