# SPDX-License-Identifier: Apache-2.0

"""Looks at what LeRobot made, in the environment of one LeRobot: `make lerobot-test` calls it.

    python check.py rows DATASET SESSION  rows, those whose touch a frame of SESSION has, different
    python check.py replayed DATASET LOG  actions of the first episode, and those that LOG has
    python check.py loads EXPORT          rows, and those that LeRobotDataset gives as the file has

SESSION: the recording that the skin replayed. EXPORT: made of it by `tactile-cdma export`.
Prints the numbers, one line.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.dataset
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_robot_tactile_cdma import touch_of

from tactile_cdma import Decoder, read_recording

SKIN = "observation.tactile.skin"


def opened(root: str, **more: object) -> LeRobotDataset:
    """Open a dataset as its users do."""
    return LeRobotDataset("me/try", root=root, **more)


def column(root: str, name: str) -> np.ndarray:
    """Read a column of the Parquet files without LeRobot, (rows, …)."""
    table = pyarrow.dataset.dataset(Path(root, "data"), format="parquet").to_table([name])
    return np.array(table[name].to_pylist())


def rows(root: str, session: str) -> tuple[int, int, int]:
    """Compare the touch of a dataset with the frames of the recording, decoded offline."""
    names = opened(root).meta.features["observation.state"]["names"]
    touch = touch_of(names, column(root, "observation.state").astype(np.float32))[SKIN]
    decoder = Decoder(nodes=touch.shape[1])
    read = (frame for data, t_s in read_recording(session) for frame in decoder.feed(data, t_s))
    known = {np.nan_to_num(frame.pressure_pa).astype(np.float32).tobytes() for frame in read}
    found = [row.tobytes() for row in touch]
    return len(found), sum(row in known for row in found), len(set(found))


def replayed(root: str, log: str) -> tuple[int, int]:
    """Compare what was sent with what was recorded."""
    wanted = column(root, "action")[column(root, "episode_index") == 0].astype(np.float32)
    lines = Path(log).read_text().splitlines()
    sent = np.array([json.loads(line) for line in lines], np.float32).reshape(-1, wanted.shape[1])
    return len(wanted), int((sent[: len(wanted)] == wanted[: len(sent)]).all(axis=1).sum())


def loads(root: str) -> tuple[int, int]:
    """Load an export in batches, with a row of the past each."""
    dataset, wanted = opened(root, delta_timestamps={SKIN: [-1 / 30, 0.0]}), column(root, SKIN)
    found = torch.utils.data.DataLoader(dataset, batch_size=64)
    given = np.concatenate([batch[SKIN][:, 1].numpy() for batch in found])
    return len(wanted), int((given == wanted.astype(np.float32)).all(axis=1).sum())


if __name__ == "__main__":
    print(*{"rows": rows, "replayed": replayed, "loads": loads}[sys.argv[1]](*sys.argv[2:]))
