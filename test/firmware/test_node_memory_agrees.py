# SPDX-License-Identifier: Apache-2.0

"""Host and firmware agree on a node's memory and its limits."""

import ctypes

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.frame import MEASURING_S, ORTHOGONAL, SPARSE, FrameSpec
from tactile_cdma.hardware.node_memory import MCUS, Mcu, node_memory
from test.support.examples import examples
from test.support.node_limits import CORRUPT, GOOD, UNFIT, limits, load


@st.composite
def specs(draw: st.DrawFn) -> FrameSpec:
    """Skins about the limits of nodes, on either side of them."""
    sparse = draw(st.booleans())
    order = 912 if sparse else draw(st.sampled_from([1, 2, 20, 32, 1024, 1032]))
    resync = draw(st.sampled_from([0, order] if sparse else [0, 16, 32, order]))
    slow_s = st.integers(20, 100)
    fast_s = st.sampled_from([0.4, 0.5, 0.55, 0.75, 1, 2, 2.1, 15.75, 16, 16.25])
    shape = {
        "nodes": 4000 if sparse else 1,
        "codes": SPARSE if sparse else ORTHOGONAL,
        "first_row": min(1, order - 1),
        "bits": draw(st.integers(8, 10)),
        "order": order,
        "chip_s": draw(slow_s | fast_s) / 1e6,
        "parity": draw(st.booleans()),
        "resync_chips": resync,
        "scramble": sparse or (order >= 4 and draw(st.booleans())),
        "guard_chips": draw(st.integers(1, 5) | st.integers(35, 200)) if resync else 0,
    }
    frame_us = round(FrameSpec(**shape, frame_period_s=100.0).frame_s * 1e6)
    assume(frame_us < 9_990_000)  # a node's longest period is 10 s
    period_us = max(1000, frame_us + draw(st.integers(900, 1100)))  # a node's shortest is 1 ms
    return FrameSpec(**shape, frame_period_s=period_us / 1e6)


@pytest.mark.parametrize("mcu", MCUS)
@examples(200)
@given(spec=specs())
def test_what_the_host_writes_the_firmware_takes_and_nothing_more(
    core: ctypes.CDLL, mcu: str, spec: FrameSpec
) -> None:
    gap_s = spec.frame_period_s - spec.frame_s
    if gap_s < MEASURING_S * (1 - 1e-9):  # the firmware is content with 0.964 ms
        with pytest.raises(
            SpecError,
            match=r"measure in|longer code row|in octets|anew|runs at|cycles|scrambles|sparse",
        ):
            node_memory(spec, 1, mcu=mcu)
        return
    try:
        memory = node_memory(spec, 1, mcu=mcu)
    except SpecError:
        try:
            memory = unchecked_memory(spec)
        except SpecError:  # beyond what a memory can say
            assert spec.chip_s < 0.5e-6
            return
        assert load(core, memory, limits(mcu))[0] == UNFIT
        return
    fault, record, row = load(core, memory, limits(mcu))
    assert fault == GOOD
    assert record == memory[: len(record)]
    octets = np.frombuffer(row, np.uint8)
    if spec.sparse:
        assert row[:12].hex() == "9739e2e8db8c04293bde3bd6"  # docs/protocol.md
    else:
        chips = np.unpackbits(octets[: -(-spec.order // 8)], bitorder="little")[-spec.order :]
        assert np.array_equal(chips > 0, spec.node_rows[0] > 0)
    assert load(core, memory[:-1] + bytes([memory[-1] ^ 1]), limits(mcu))[0] == CORRUPT


def unchecked_memory(spec: FrameSpec) -> bytes:
    """The memory of a node that can do anything."""
    restarts = spec.sparse and spec.resync_chips > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            MCUS, "any", Mcu("", 4096, 500, 500, 500, bits_restart=restarts, restart_s=0.0)
        )
        return node_memory(spec, 1, mcu="any")
