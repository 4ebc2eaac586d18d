# SPDX-License-Identifier: Apache-2.0

"""Feeds a torch module with the last 32 frames of a skin, at every frame (78 Hz), without copies.

    python examples/live_torch.py 'sim://?scene=moving' --seconds 10
    python examples/live_torch.py /dev/ttyACM0 --params config/wired_skin.yaml
    python examples/live_torch.py replay://a.skin

The frames lie in a ring that torch shares: what arrives is written once, and the module sees the
last 32 frames as one contiguous tensor, (1, 2, 32, taxels): pressure in units of SCALE_PA, and 1
where it is a valid reading. A taxel without one holds its last. The network here is not trained:
put yours in its place. The last line tells how long a frame took from its middle on the wire to the
network's answer (latency), and how much of that was the network (network).
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

from tactile_cdma import PortError, RecordingEndError, Skin, read_parameters

FRAMES = 32
SCALE_PA = 50e3
"""Pressure that a network sees as 1: one scale for all taxels; see docs/recording.md."""


class RecentFrames:
    """The last `length` frames, oldest first, always at hand as one view.

    Every frame is written twice into a buffer of twice the length, half of it apart, so that any
    `length` successive frames lie side by side somewhere: push() costs two short writes, and
    `window` nothing. count: frames pushed so far.
    """

    def __init__(self, length: int, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> None:
        self._length = length
        self._frames = np.zeros((2 * length, *shape), dtype=dtype)
        self.count = 0

    def push(self, frame: NDArray[Any]) -> None:
        """Add the newest frame; it takes the place of the oldest."""
        place = self.count % self._length
        self._frames[place] = self._frames[place + self._length] = frame
        self.count += 1

    @property
    def window(self) -> NDArray[Any]:
        """(length, *shape) a view, zeros before the first frames; the next push() changes it."""
        begin = self.count % self._length
        return self._frames[begin : begin + self._length]


class TouchNet(torch.nn.Module):
    """Two convolutions over time, and three numbers from all taxels: say, a velocity to command."""

    def __init__(self, taxels: int) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Conv2d(2, 8, (5, 1), stride=(2, 1)),
            torch.nn.ReLU(),
            torch.nn.Conv2d(8, 8, (5, 1), stride=(2, 1)),
            torch.nn.ReLU(),
            torch.nn.Flatten(),
            torch.nn.Linear(8 * 5 * taxels, 3),
        )

    def forward(self, touch: torch.Tensor) -> torch.Tensor:
        """(b, 2, FRAMES, taxels) → (b, 3)."""
        answer: torch.Tensor = self.layers(touch)
        return answer


def main() -> None:
    """Run the network at every frame until the time is over."""
    parser = argparse.ArgumentParser(description="runs a torch module on the last frames of a skin")
    parser.add_argument("port", help="device, sim:// or replay://FILE")
    parser.add_argument("--params", help="parameter file of the skin; else 16 plain nodes")
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # a network this small only waits for other threads

    parameters = read_parameters(arguments.params) if arguments.params else {}
    with Skin(**{**parameters, "port": arguments.port}) as skin, torch.inference_mode():
        taxels = len(skin.layout)
        network = TouchNet(taxels).eval()
        recent = RecentFrames(FRAMES, (2, taxels))
        held = np.zeros(taxels, dtype=np.float32)
        begun_s, latencies_s, networks_s, shared = time.monotonic(), [], [], True
        while time.monotonic() - begun_s < arguments.seconds:
            try:
                frame = skin.newest()  # control has no use for older ones
            except RecordingEndError:
                break
            except PortError as error:  # a policy has to stop here
                print(error, file=sys.stderr)
                break
            valid = np.isfinite(frame.pressure_pa)
            held = np.where(valid, frame.pressure_pa / np.float32(SCALE_PA), held)
            recent.push(np.stack([held, valid]))
            if recent.count < FRAMES:
                continue
            asked_s = time.monotonic()
            touch = torch.from_numpy(recent.window).transpose(0, 1)[None]  # views of the ring
            shared &= touch.data_ptr() == recent.window.ctypes.data
            network(touch)
            now_s = time.monotonic()
            networks_s.append(now_s - asked_s)
            latencies_s.append(now_s - frame.t_host)
        latency_ms, network_ms = (
            1e3 * np.median(values or [np.nan]) for values in (latencies_s, networks_s)
        )
        print(
            f"answers={len(latencies_s)} dropped={skin.dropped} shared={int(shared)} "
            f"latency_ms={latency_ms:.1f} network_ms={network_ms:.2f}"
        )


if __name__ == "__main__":
    main()
