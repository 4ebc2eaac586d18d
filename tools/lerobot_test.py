# SPDX-License-Identifier: Apache-2.0

"""Runs the LeRobot plugin in every LeRobot that it serves: `make lerobot-test`.

Each LeRobot is installed beside the checkout and the plugin, in build/lerobot, with a dummy arm and
hand (integrations/…/try). Its own commands then record a skin, replay the episode, train a policy
for some steps, and let it act; an export of the same skin is loaded, too. The skin replays one
recording, so that every row of touch that LeRobot wrote has to be a frame of it as it is decoded
offline, bit for bit.
The last line counts. Torch is some gigabytes; what is installed once is used again.
"""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
PLUGIN = CHECKOUT / "integrations" / "lerobot_robot_tactile_cdma"
TRY = PLUGIN / "try"
PLACE = CHECKOUT / "build" / "lerobot"
PIP = ("-m", "pip", "install", "-q", "--no-input", "--disable-pip-version-check")
STEPS, FPS, SECONDS = 20, 20, 4
SESSION_S = 40
"""Length of the recording, s: longer than any of the commands has the skin open."""
LEAST_DIFFERENT = 5
"""Rows of a dataset that have to differ from each other: the skin is touched now and then."""


@dataclass(frozen=True)
class Release:
    """A LeRobot to try. pythons: versions of Python that it runs on, those we prefer first."""

    wanted: str
    pythons: tuple[str, ...]
    policy: tuple[str, ...]
    """Command by which a policy acts and what it did is recorded."""


RELEASES = (
    Release(
        "lerobot==0.4.4", ("3.11", "3.12"), ("lerobot-record", "--dataset.repo_id=me/eval_try")
    ),
    Release(
        "lerobot[core_scripts,training]>=0.6,<0.7",
        ("3.12", "3.13", "3.14"),
        ("lerobot-rollout", "--strategy.type=episodic", "--dataset.repo_id=me/rollout_try"),
    ),
)


@dataclass
class Tally:
    recorded: int = 0
    trained: int = 0
    equal: int = 0
    failed: int = 0

    def check(self, what: str, is_right: bool) -> None:
        self.failed += not is_right
        print(f"  {what}: {'ok' if is_right else 'FAILED'}", flush=True)


def main() -> int:
    """Try all releases; returns the exit code."""
    PLACE.mkdir(parents=True, exist_ok=True)
    versions, tally = [], Tally()
    for release in RELEASES:
        python = next(filter(None, map(interpreter, release.pythons)), None)
        if python is None:
            print(f"{release.wanted}: no Python {' or '.join(release.pythons)} here: not tried")
            tally.failed += 1
            continue
        try:
            tools = installed(release, python)
            version = said(tools / "python", "-c", VERSION)
            print(f"LeRobot {version} on {python}", flush=True)
            versions.append(version)
            tried(release, tools, PLACE / f"run{version}", tally)
        except subprocess.CalledProcessError as error:
            print(f"{error}\n{error.output or ''}"[-3000:])
            tally.failed += 1
    print(
        f"versions={','.join(versions)} recorded={tally.recorded} trained_steps={tally.trained} "
        f"live_equal={tally.equal} failed={tally.failed}"
    )
    return 1 if tally.failed else 0


VERSION = "from importlib.metadata import version; print(version('lerobot'))"


def interpreter(version: str) -> str | None:
    """Find a Python that works, also one of pyenv's, whose shims may have nothing behind them."""
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    kept = (str(each) for each in root.glob(f"versions/{version}*/bin/python{version}"))
    for python in (shutil.which(f"python{version}"), *kept):
        probe = [python or "false", "-c", "import ensurepip, venv, sqlite3, lzma"]
        if subprocess.run(probe, capture_output=True).returncode == 0:
            return python
    return None


def installed(release: Release, python: str) -> Path:
    """Install the release, the checkout, the plugin and dummies; returns the folder of commands."""
    venv = PLACE / f"venv{''.join(c if c.isalnum() else '_' for c in release.wanted)}"
    if not (venv / "bin" / "python").exists():
        said(python, "-m", "venv", venv)
    said(venv / "bin" / "python", *PIP, release.wanted)
    dummies = TRY / "lerobot_robot_tactile_cdma_try"
    said(venv / "bin" / "python", *PIP, CHECKOUT, PLUGIN, dummies)
    return venv / "bin"


def tried(release: Release, tools: Path, place: Path, tally: Tally) -> None:
    """Record, replay, train, act, and load an export; count what is right."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    session, export, log = place / "session.skin", place / "export", place / "sent"
    skin = place / "skin.yaml"
    skin.write_text(f"/**:\n  ros__parameters:\n    port: replay://{session}\n    nodes: 16\n")
    tactile, check = tools / "tactile-cdma", (tools / "python", TRY / "check.py")
    said(tactile, "record", "sim://?scene=moving", session, "--nodes=16", f"--seconds={SESSION_S}")
    said(tactile, "export", session, "--lerobot", export, "--fps=30", "--samples=last")
    rows, equal = numbers(*check, "loads", export)
    tally.check(f"export loads, {equal} of {rows} rows", 0 < rows == equal)

    robot = (
        "--robot.type=tactile_cdma",
        f"--robot.skin={skin}",
        f"--robot.robot={{type: tried_arm, log: {log}}}",
        "--play_sounds=false",
    )
    hand = ("--teleop.type=tried_hand",)
    kept = (
        "--dataset.single_task=try",
        "--dataset.push_to_hub=false",
        f"--dataset.fps={FPS}",
        f"--dataset.episode_time_s={SECONDS}",
        "--dataset.reset_time_s=0",
    )
    first = "--dataset.repo_id=me/try", f"--dataset.root={place / 'first'}"
    said(tools / "lerobot-record", *robot, *hand, *first, *kept, "--dataset.num_episodes=2")
    tally.recorded += compared("recorded", place / "first", session, check, tally)

    log.unlink()
    said(tools / "lerobot-replay", *robot, *first, "--dataset.episode=0")
    wanted, sent = numbers(*check, "replayed", place / "first", log)
    tally.check(f"replayed, {sent} of {wanted} actions", 0 < wanted == sent)

    said(tools / "lerobot-train", *first, *TRAINING, f"--output_dir={place / 'trained'}")
    policy = place / "trained" / "checkpoints" / "last" / "pretrained_model"
    tally.check(f"trained, {STEPS} steps", (policy / "model.safetensors").exists())
    tally.trained += STEPS

    command, *options = release.policy
    acted = f"--dataset.root={place / 'acted'}"
    acts = (f"--policy.path={policy}", "--policy.device=cpu", acted, *kept)
    said(tools / command, *options, *robot, *acts, "--dataset.num_episodes=1")
    compared("acted", place / "acted", session, check, tally)


TRAINING = (
    "--dataset.video_backend=pyav",
    "--policy.type=act",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.pretrained_backbone_weights=null",
    "--policy.dim_model=64",
    "--policy.chunk_size=10",
    "--policy.n_action_steps=5",
    f"--steps={STEPS}",
    f"--save_freq={STEPS}",
    "--batch_size=4",
    "--num_workers=0",
    "--wandb.enable=false",
)


def compared(
    what: str, dataset: Path, session: Path, check: tuple[Path, Path], tally: Tally
) -> int:
    """Compare a dataset's touch with the recording's; returns the number of rows."""
    rows, equal, different = numbers(*check, "rows", dataset, session)
    is_right = 0 < rows == equal and different >= LEAST_DIFFERENT
    tally.check(f"{what}, {equal} of {rows} rows as decoded, {different} different", is_right)
    tally.equal += equal
    return rows


def numbers(*command: str | Path) -> list[int]:
    return [int(word) for word in said(*command).splitlines()[-1].split()]


def said(*command: str | Path) -> str:
    """Run a command without a network or a screen; returns what it printed."""
    alone = {"HF_HUB_OFFLINE": "1", "WANDB_MODE": "disabled", "HF_HOME": str(PLACE / "hub")}
    words = list(map(str, command))
    done = subprocess.run(
        words, env={**os.environ, **alone}, text=True, check=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
