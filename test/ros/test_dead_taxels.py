# SPDX-License-Identifier: Apache-2.0

"""A dead taxel of a running driver is masked, or left out by dead_share; how sure others are."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped

from tactile_cdma.msg import TactileContacts
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.ros.client import SkinClient
from tactile_cdma.srv import Mask
from test.support.calibrations import write_calibration
from test.support.skin_client import Client, running
from test.support.waiting import wait_for

DEAD = "sim://?scene=idle&heartbeat=20&dead=3"


class Watch:
    """What a control loop hears of a skin."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.wrenches = client.heard(WrenchStamped, "/skin/wrench", 100)
        self.contacts = client.heard(TactileContacts, "/skin/contacts", 100)

    def mask(self, *nodes: int, clear: bool = False) -> Mask.Response:
        response: Mask.Response = self.client.call(
            Mask, "mask", Mask.Request(nodes=nodes, clear=clear)
        )
        return response

    def wait(self, in_service: int, knows: bool, **info: list[int]) -> None:
        """Wait until messages and info say so."""

        def says() -> bool:
            told = self.client.infos[-1]
            there = all(list(getattr(told, name)) == nodes for name, nodes in info.items())
            if not (self.contacts and self.wrenches and there):
                return False
            newest: Any = self.contacts[-1]
            is_nan = np.isnan(self.wrenches[-1].wrench.force.z)
            seen = newest.taxels_in_service, newest.untouched, bool(is_nan)
            return seen == (in_service, knows, not knows) and newest.info_id == told.info_id

        wait_for(says)


def test_a_dead_taxel_that_is_masked_holds_up_the_wrench_no_more_also_after_a_restart(
    tmp_path: Path,
) -> None:
    with running(port=DEAD, state_folder=str(tmp_path)) as (_, client):
        watch = Watch(client)
        watch.wait(16, False, masked=[])
        assert not watch.mask(17).success
        answer = watch.mask(3)
        assert answer.success and list(answer.masked) == [3]
        watch.wait(15, True, masked=[3])
    with running(port=DEAD, state_folder=str(tmp_path)) as (_, client):
        watch = Watch(client)
        watch.wait(15, True, masked=[3])
        assert client.set(masked="3, 4")[0]
        watch.wait(14, True, masked=[3, 4])
        refused = watch.mask(4, clear=True)
        assert not refused.success and "parameter" in refused.message
        assert client.set(masked="")[0]
        answer = watch.mask(clear=True)
        assert answer.success and list(answer.masked) == []
        watch.wait(16, False, masked=[])
        assert not client.set(masked="17")[0]


def test_a_dead_taxel_is_left_out_only_where_that_is_asked_for_and_all_is_told() -> None:
    with running(port=DEAD, stale_after_s=0.5) as (_, client):
        watch = Watch(client)
        wait_for(lambda: "node 3" in client.entry("nodes").message)
        watch.wait(16, False, retired=[])
        assert client.set(dead_share=0.1)[0]
        watch.wait(15, True, retired=[3], masked=[])
        wait_for(lambda: client.says("out of service, as dead_share allows: node 3"))
        assert client.set(dead_share=0.06)[0]  # less than one of 16
        watch.wait(16, False, retired=[])


def test_how_sure_a_reading_is_comes_with_it_while_that_is_asked_for(tmp_path: Path) -> None:
    curve = replace(PressureCurve.two_stage(), residual_v=2e-3, loop=0.05)
    path = tmp_path / "known.yaml"
    write_calibration(path, Calibration.default(curve, 16), AdcScale())
    with running(port="sim://?scene=all&threshold=0", calibration_file=str(path)) as (_, client):
        user = SkinClient(client, "/skin", frames=True)
        wait_for(lambda: user.frame is not None)
        assert user.frame is not None and not len(user.frame.sigma_pa)
        assert client.set(publish_sigma=True)[0]
        wait_for(lambda: user.frame is not None and len(user.frame.sigma_pa) == 16)
        frame = user.frame
        assert (frame.sigma_pa > 0.04 * frame.pressure_pa).all()
        assert (frame.sigma_pa < 0.1 * frame.pressure_pa + 1e3).all()
        assert client.set(publish_sigma=False)[0]
        wait_for(lambda: user.frame is not None and not len(user.frame.sigma_pa))
