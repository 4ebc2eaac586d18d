# SPDX-License-Identifier: Apache-2.0

"""A thousand nodes on one wire, to the pin: `make firmware-thousand`; more of them: crowd.py.

    900 images of the fast node (simavr) → pins → analog line → the RP2040's image → USB → driver

Crystals are off by up to 50 ppm, levels by 1 %, the sync line reaches nodes up to 0.2 µs late, and
all nodes send another random word in every frame. Every word is compared with what was pressed.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import crowd
from emulated import EmulationError
from rp2040 import HUB, ROOT_PORT, Bus, EmulatorError
from rp2040_skin import Rp2040Skin
from skin import CRYSTALS, PressedSkin, Spread, reference_amplifier, reference_nodes
from tactile_cdma.base.errors import SpecError, TactileError
from tactile_cdma.config.frame_rate import FAST
from tactile_cdma.config.parameters import Value, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.sim.scene import SkinGeometry
from trial import Trial, press_and_decode

CONFIG = Path(__file__).resolve().parents[2] / "config"
PARAMS, SPARSE_PARAMS = CONFIG / "thousand_skin.yaml", CONFIG / "sparse_skin.yaml"
FRAMES = 12
SETTLING = 4
"""First frames, not counted: nodes start up and measure two periods of the sync line."""
HEAVIEST_PA = 140e3
"""Largest pressure, Pa: the end of the usual curve's range."""
QUICK = {"nodes": 128, "rows": 8, "columns": 16, "order": 912}
"""Fewer nodes, with all else as it is."""


LOSE_EVERY = 5
"""Frames, one of which is lost to a second driver."""
AMPLITUDE: dict[str, Value] = {"amplitude_mv": 4.05}
"""Amplitude, mV, with room for all nodes at once: `design_amplifier.py --params
config/sparse_skin.yaml --active 1`, in firmware/analog."""
STREAM_BYTES = 4096
"""More at once than a digitizer sends that does not stream."""


class RandomPresses:
    """Is a scene in which no taxel knows anything of another, or of its own past."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def __call__(
        self, t_s: float, skin: SkinGeometry
    ) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Return the pressures at a time: (n,) Pa."""
        return self._rng.uniform(0, HEAVIEST_PA, len(skin.positions_m))


class Listener:
    """Listens to the digitizer of a skin: how much it says, and a recording of that.

    A `skin.Digitized`.
    """

    def __init__(self, skin: Rp2040Skin, recorder: Recorder | None, wait_s: float = 0.0) -> None:
        """wait_s: by which the recording's times are later than the emulation's."""
        self._skin, self._recorder = skin, recorder
        self._bytes, self._since_ns = 0, 0
        self._origin_s = time.monotonic() + wait_s

    @property
    def now_ns(self) -> int:
        """Tell how far the emulation has come."""
        return self._skin.now_ns

    @property
    def bytes_per_s(self) -> float:
        """Return the rate of the stream since it is under way, bytes/s."""
        return self._bytes / ((self.now_ns - self._since_ns) * 1e-9)

    def run(self, t_ns: int) -> None:
        """Run everything to a time."""
        self._skin.run(t_ns)

    def write(self, data: bytes) -> None:
        """Pass bytes from the host to the digitizer."""
        self._skin.write(data)

    def read(self) -> bytes:
        """Tell what the host has received since the last call."""
        data = self._skin.read()
        if self._since_ns:
            self._bytes += len(data)
        elif len(data) > STREAM_BYTES:
            self._since_ns = self.now_ns
        if self._recorder is not None:
            self._recorder.write(data, self._origin_s + self.now_ns * 1e-9)
        return data


@dataclass(frozen=True, slots=True)
class Outcome:
    """Holds a trial, and what it asked of the digitizer.

    cpu_load: share of time awake. bytes_per_s: over USB. nak_share: of the host's requests, those
    for which there was no packet.
    """

    trial: Trial
    cpu_load: float
    bytes_per_s: float
    nak_share: float


def on_one_wire(
    values: dict[str, Value],
    frames: int = FRAMES,
    spread: Spread = CRYSTALS,
    record: Path | None = None,
    bus: Bus | None = ROOT_PORT,
) -> Outcome:
    """Run a skin of these parameters until so many frames have come. record: a file to write."""
    config = SkinConfig.of(values)
    nodes = reference_nodes(config, spread, mcu=FAST, threshold=0, rest=0)
    with ExitStack() as stack:
        recorder = None
        if record is not None:
            recorder = stack.enter_context(Recorder(record, "emulated RP2040", 0, values))
        skin = stack.enter_context(Rp2040Skin(nodes, reference_amplifier(config), bus))
        listener = Listener(skin, recorder)
        pressed = PressedSkin(config, RandomPresses(spread.seed), skin, listener)
        trial = press_and_decode(pressed, config, frames, SETTLING, LOSE_EVERY)
        share = skin.chip.usb_naks / max(skin.chip.usb_asks, 1.0)
        return Outcome(trial, skin.chip.load, listener.bytes_per_s, share)


def main() -> int:
    """Print the counts last; exit code 1 on any error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="128 nodes, or 600 images of more")
    parser.add_argument("--nodes", type=int, help="with sparse codes, those of sparse_skin.yaml")
    parser.add_argument("--hub", action="store_true", help="USB goes through a hub")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--record", type=Path, metavar="FILE", help="record what USB carries")
    arguments = parser.parse_args()
    if arguments.nodes is not None:
        return many(arguments)
    values = read_file(PARAMS) | (QUICK if arguments.quick else {})
    spread, begin = replace(CRYSTALS, seed=arguments.seed), time.monotonic()
    try:
        bus = HUB if arguments.hub else ROOT_PORT
        found = on_one_wire(values, FRAMES, spread, arguments.record, bus)
    except (EmulationError, EmulatorError, OSError, TactileError) as error:
        print(f"firmware-thousand: {error}", file=sys.stderr)
        return 1
    trial, spec = found.trial, SkinConfig.of(values).spec
    print(f"cpu_load={found.cpu_load:.2f} ({time.monotonic() - begin:.0f} s)")
    print(
        f"nodes={spec.nodes} order={spec.order} chip_us={spec.chip_s * 1e6:g} "
        f"frame_ms={spec.frame_period_s * 1e3:g} frames={trial.frames} wrong={trial.wrong} "
        f"missed={trial.silent} lost_samples={trial.lost_samples} lost_on_purpose={trial.lost} "
        f"usb_kb_s={found.bytes_per_s / 1e3:.0f} nak_share={found.nak_share:.2f}"
    )
    return int(trial.frames < FRAMES or trial.wrong + trial.silent + trial.lost_samples > 0)


def many(arguments: argparse.Namespace) -> int:
    """Run the trial with nodes of sparse codes."""
    values = read_file(SPARSE_PARAMS) | AMPLITUDE
    images = crowd.QUICK if arguments.quick else None
    spread, begin = replace(CRYSTALS, seed=arguments.seed), time.monotonic()
    try:
        if arguments.nodes != values["nodes"]:
            raise SpecError(
                f"NODES is {arguments.nodes}; {SPARSE_PARAMS.name} has {values['nodes']}, which is "
                "what can be run; without NODES, 900 orthogonal ones run"
            )
        found = crowd.on_one_wire(values, images, spread, arguments.record)
    except (EmulationError, EmulatorError, OSError, TactileError) as error:
        print(f"firmware-thousand: {error}", file=sys.stderr)
        return 1
    spec = SkinConfig.of(values).spec
    print(
        f"images={found.heard.size} most_speaking={found.most} heard_in_turns={found.heard.sum()} "
        f"cpu_load={found.cpu_load:.2f} ({time.monotonic() - begin:.0f} s)"
    )
    print(
        f"nodes={spec.nodes} chips={spec.order} chip_us={spec.chip_s * 1e6:g} "
        f"frame_ms={spec.frame_period_s * 1e3:g} frames={found.frames} speaking={found.speaking} "
        f"wrong={found.wrong} missed={found.missed} unflagged={found.unflagged} "
        f"lost_samples={found.lost_samples} lost_on_purpose={found.lost} blind_frames={found.blind}"
    )
    return int(not found.all_is_well)


if __name__ == "__main__":
    sys.exit(main())
