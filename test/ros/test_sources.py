# SPDX-License-Identifier: Apache-2.0

"""A board that prints numbers, as a driver node of ROS: topics, diagnostics, what is wrong."""

import math

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from tactile_cdma.msg import TactileContacts
from test.support.printing_board import checked, printing
from test.support.skin_client import running
from test.support.waiting import wait_for

QUERY = "before=index,us&after=check"


def is_well(stream: DiagnosticStatus) -> bool:
    """Whether nothing is wrong with it, but that a busy computer is late."""
    return stream.level == DiagnosticStatus.OK or "this computer does not keep up" in stream.message


def test_a_printing_board_is_a_skin_on_all_topics() -> None:
    def line(made: int) -> bytes:
        codes = [1022] * 6 if made < 300 else [700, 1022, 1022, 700, 1022, 1022]
        return checked([made, made * 10_000, *codes])

    with printing(line) as device:
        port = f"text://{device}?{QUERY}"
        with running(port=port, nodes=6, rows=2, columns=3) as (_, client):
            contacts = client.heard(TactileContacts, "/skin/contacts", 1000)
            wait_for(lambda: contacts[-1].touched)
            wait_for(lambda: is_well(client.entry("stream")))
            wait_for(lambda: abs(float(client.value("stream", "expected rate (Hz)")) - 100) < 2)
            array, origin = client.arrays[-1], client.infos[-1].measured_by
    assert origin == client.infos[-1].ORIGIN_BOARD
    pressure_pa = np.array(array.pressure)
    assert (pressure_pa[[0, 3]] > 10e3).all() and (pressure_pa[[1, 2, 4, 5]] < 2e3).all()
    assert math.isfinite(contacts[-1].wrench.force.z) and contacts[-1].contacts


def test_another_count_of_numbers_is_in_the_diagnostics() -> None:
    with (
        printing(lambda _: b"1,2,3\n") as device,
        running(port=f"text://{device}", nodes=6) as (_, client),
    ):
        wait_for(lambda: client.says("lines of 3 numbers come, but nodes is 6"))
