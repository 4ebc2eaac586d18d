# SPDX-License-Identifier: Apache-2.0

"""`make firmware-thousand`: fast nodes on one wire; it must be able to fail."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import crowd
from emulated import Node
from skin import reference_nodes
from tactile_cdma.config.parameters import read_file
from thousand import AMPLITUDE, FRAMES, PARAMS, QUICK, SPARSE_PARAMS, on_one_wire

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("node_images", "rp2040_image")]
VALUES = read_file(PARAMS)
FEW = VALUES | QUICK | {"nodes": 20, "rows": 4, "columns": 5}
SPARSE = read_file(SPARSE_PARAMS) | AMPLITUDE
CROWD = SPARSE | {"nodes": 80, "rows": 8, "columns": 10, "order": 80, "resync_chips": 80,
                  "frame_period_ms": 3.4, "amplitude_mv": 15.0}  # fmt: skip
"""40 may speak in a frame, so of a hug none is told, and all are by turns."""
USB_BYTES_PER_S = 19 * 64 * 1000
"""What full-speed USB can carry in bulk: 19 packets of 64 bytes in a millisecond."""


def test_every_word_of_128_nodes_is_right() -> None:
    found = on_one_wire(VALUES | QUICK)
    trial = found.trial
    assert trial.frames >= FRAMES and trial.lost >= 2
    assert (trial.wrong, trial.silent, trial.lost_samples) == (0, 0, 0)
    assert 0.68e6 < found.bytes_per_s < 0.6 * USB_BYTES_PER_S
    assert 0.5 < found.nak_share < 0.95, "the host asks when there is nothing, and is declined"
    assert found.cpu_load < 0.6
    codes = np.array([*trial.words.values()])
    assert np.unique(codes).size > 400, "nodes say all kinds of words"


@pytest.mark.parametrize("repeats", [False, True])
def test_a_crowd_is_heard_by_turns(repeats: bool) -> None:
    found = crowd.on_one_wire(CROWD | {"nodes_repeat": repeats})
    assert found.all_is_well, found
    assert found.most == 80 and found.in_groups >= 2 * (4 + 2)
    assert found.speaking > 400
    assert found.lost >= 4, "and of frames that were lost nothing false is claimed"


def test_nodes_with_each_others_numbers_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes 3 and 8 have changed places: other codes, and another group's turns."""

    def changed(*given: Any, **options: Any) -> list[Node]:
        nodes = reference_nodes(*given, **options)
        nodes[2], nodes[7] = nodes[7], nodes[2]
        return nodes

    monkeypatch.setattr(crowd, "reference_nodes", changed)
    found = crowd.on_one_wire(CROWD, step_count=crowd.SETTLING + 30)
    assert found.wrong > 0 and found.missed > 0
    assert not found.all_is_well


def test_the_driver_publishes_4000_taxels(ros: None, tmp_path: Path) -> None:
    """Of which 20 are on the wire: what they said, of all others nothing."""
    from test.support.skin_client import running, wait_for

    recording, images = tmp_path / "crowd.skin", 20
    found = crowd.on_one_wire(SPARSE, images, record=recording, step_count=crowd.SETTLING + 30)
    assert found.frames and not found.wrong + found.missed + found.doubted
    wired = np.linspace(0, 3999, images).round().astype(int)
    said = {(node, code) for node, code in found.said if code != crowd.REST_CODE}
    assert said
    values = {**SPARSE, "port": f"replay://{recording}?loop=true", "publish_voltage": True}
    with running(**values) as (_, client):
        wait_for(lambda: said <= heard_codes(client.arrays))
    assert all(len(message.pressure) == 4000 for message in client.arrays)
    assert {node for node, _ in heard_codes(client.arrays)} <= {*wired.tolist()}


def heard_codes(arrays: Sequence[Any]) -> set[tuple[int, int]]:
    """Nodes, from 0, and the codes that they have said, of every message."""
    found = set()
    for message in [*arrays]:
        codes = np.array(message.voltage) / (3.3 / 1024)
        for node in np.flatnonzero(~np.isnan(codes)):
            found.add((int(node), round(codes[node])))
    return found
