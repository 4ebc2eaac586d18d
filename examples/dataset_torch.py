# SPDX-License-Identifier: Apache-2.0

"""Trains a network on an exported dataset, with torch and pyarrow, without LeRobot.

    tactile-cdma record 'sim://?scene=moving' touch.skin --seconds 20 --nodes 16
    tactile-cdma export touch.skin --lerobot touch --fps 30
    python examples/dataset_torch.py touch

The network predicts the pressures of the next row from the window of this one. It shows what
docs/learning.md says: one scale for all taxels, the mask as a second input, no loss where nothing
was read, and no pair of rows across two episodes. The last line has the mean squared error of the
first and the last epoch, in units of the pressures' standard deviation.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet
import torch
from torch.utils.data import DataLoader, TensorDataset


def read(folder: Path, name: str) -> torch.Tensor:
    """A column of all data files, (rows, …) float32."""
    cells = pyarrow.parquet.read_table(folder / "data", columns=[name]).column(name).to_pylist()
    return torch.from_numpy(np.array(cells, dtype=np.float32))


def main() -> None:
    """Read, train, report."""
    parser = argparse.ArgumentParser(description="trains a network on an exported dataset")
    parser.add_argument("dataset", type=Path, help="folder that export --lerobot wrote")
    parser.add_argument("--patch", default="skin")
    parser.add_argument("--epochs", type=int, default=20)
    arguments = parser.parse_args()
    torch.manual_seed(1)

    touch = f"observation.tactile.{arguments.patch}"
    every = json.loads((arguments.dataset / "meta/stats.json").read_text())
    if touch not in every:
        stem = touch.removesuffix(arguments.patch)
        names = [key.removeprefix(stem) for key in every if key.startswith(stem)]
        patches = ", ".join(name for name in names if "." not in name) or "none"
        raise SystemExit(f"{arguments.dataset}: no patch {arguments.patch} (there is {patches})")
    statistics = every[touch]
    mean, std = (np.ravel(statistics[key])[0] for key in ("mean", "std"))  # the same for all taxels
    pressure = (read(arguments.dataset, touch) - mean) / std
    valid = read(arguments.dataset, f"{touch}.valid")
    episode = read(arguments.dataset, "episode_index")

    follows = (episode[1:] == episode[:-1]).nonzero()[:, 0]
    inputs = torch.stack([pressure, valid], dim=1)[follows]  # (rows, 2, frames, taxels)
    targets, known = pressure[follows + 1, -1], valid[follows + 1, -1]
    batches = DataLoader(TensorDataset(inputs, targets, known), batch_size=32, shuffle=True)

    taxels = pressure.shape[-1]
    network = torch.nn.Sequential(
        torch.nn.Flatten(),
        torch.nn.Linear(inputs[0].numel(), 64),
        torch.nn.ReLU(),
        torch.nn.Linear(64, taxels),
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(arguments.epochs):
        total, count = 0.0, 0.0
        for now, later, mask in batches:
            error = (torch.square(network(now) - later) * mask).sum()
            optimizer.zero_grad()
            (error / mask.sum().clamp(min=1)).backward()
            optimizer.step()
            total, count = total + error.item(), count + mask.sum().item()
        losses.append(total / count)
    episodes = int(episode.max()) + 1
    print(f"pairs={len(follows)} episodes={episodes} first={losses[0]:.3f} last={losses[-1]:.3f}")


if __name__ == "__main__":
    main()
