# SPDX-License-Identifier: Apache-2.0

"""What programs hand to the public classes, wrong kinds too, and the orders in which they call."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tactile_cdma import (
    Body,
    Decoder,
    LiveObservation,
    Skin,
    TactileError,
    read_parameters,
    read_recording,
)
from tactile_cdma.sim import (
    BatchCover,
    Box,
    Cylinder,
    Foundation,
    HeightMap,
    SkinBatch,
    Sphere,
    at_force,
    pressed_pa,
)
from test.support.call_orders import MACHINES, try_orders

pytestmark = pytest.mark.xdist_group("public_skin")
STEPPED = "sim://?scene=external&speed=0&threshold=0"
NO_OBJECT = [None, "x", 5, True, np.zeros(3), {}, object()]
NO_TRUTH = [None, "no", "", 0, 1, 1.0, b"x", [True], np.ones(2), math.nan]
NO_TEXT = [None, True, 5, 1.5, b"x", [], np.zeros(2), {}, object()]
NO_NUMBER = ["5", True, [1.0], np.ones(2), {}, 1j, 10**400, math.nan, object()]
NO_TIME = [*NO_NUMBER, -1.0, np.float32(-1), -math.inf]
NO_SIZE = [*NO_TIME, None, 0, -0.0, 1e9, math.inf]
NO_WHOLE = [*NO_NUMBER, 1.5, 2**63, np.float64(1), -(2**70)]
NO_COUNT = [*NO_WHOLE, -1, np.int64(-3)]
NO_PLACE = [None, 5, "abc", (0, 0), (0, 0, math.nan), (0, 0, 2e3), (0, 0, "1"), np.zeros((3, 1))]
NO_ARRAY = [
    *(None, 5, 1.5, "x", [1.0], {}, np.zeros((2, 16), int), np.zeros((2, 16), bool)),
    *(np.zeros((2, 16), complex), np.zeros((2, 16), object), np.zeros((2, 16), np.float16)),
    np.ma.masked_array(np.zeros((2, 16)), mask=True),
]
BALL = Sphere(radius_m=0.01, position_m=(0, 0, 0.009))
AT = {"position_m": (0, 0, 0)}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """One of everything that takes arguments, in order."""
    body = tmp_path_factory.mktemp("kinds") / "body.yaml"
    body.write_text(f"process: one\npatches: {{a: {{parameters: {{port: '{STEPPED}'}}}}}}")
    with Skin(STEPPED, nodes=16) as skin:
        places = skin.layout.positions_m, skin.layout.normals, skin.layout.areas_m2
        noisy = f"{STEPPED}&sensor_noise=0.01"
        batch = SkinBatch(skin.config, 2, noisy)
        yield SimpleNamespace(
            skin=skin,
            frame=skin.step(),
            body=partial(Body, body),
            decoder=Decoder(nodes=16),
            batch=partial(SkinBatch, skin.config),
            begun=batch,
            state=batch.begin(np.zeros(())),
            idle=np.zeros((2, 16)),
            other=SkinBatch(skin.config, 3, noisy).begin(np.zeros(())),
            places=places,
            cover=Foundation(*places),
            covers=BatchCover(skin.layout),
            seen=LiveObservation.of(skin),
        )


NO_BYTES = [None, 5, "x", [1], np.zeros(3), object()]
NO_PATCH = [None, 5, 1.5, b"x", ()]
NO_PRESSURE = [*NO_ARRAY, np.zeros((16, 2)), np.zeros(16), np.zeros((2, 16), np.float32)]
NO_NOISE = [*NO_ARRAY, np.zeros((2, 1))]
NO_DONE = [*NO_ARRAY, np.zeros(3, bool), np.ma.zeros(2, bool)]
NO_PLACES = [*NO_ARRAY, np.zeros((2, 3), int), np.zeros((0, 3)), np.ma.zeros((2, 3))]
NO_TURN = [*NO_PLACE, (0, 0, 0, 0), (0, 0, 0, math.nan), (0, 0, 0, math.inf)]
NO_HEIGHTS = [*NO_ARRAY, np.zeros((1, 4)), np.zeros(4), np.full((4, 4), -math.inf)]
NO_COVER = [*NO_ARRAY, np.zeros(3), np.zeros((16, 2)), np.zeros((3, 3)), np.full((16, 3), math.nan)]
NO_NORMALS = [*NO_ARRAY, np.zeros((16, 3)), np.full((16, 3), math.nan), np.full((16, 3), 1.0)]
NO_AREAS = [*NO_ARRAY, np.zeros(16), *(np.full(16, wrong) for wrong in (math.nan, -1e-4, math.inf))]
NO_WAY = [*NO_PLACE, (0, 0, 0), (0, 0, -0.5), (0, 0, -2), np.zeros(3)]
NO_OBJECTS, NO_STIFFNESS = [*NO_OBJECT, [BALL, "x"]], [*NO_TIME, None, 0, math.inf]
CASES: dict[str, tuple[str, list[Any], Callable[[SimpleNamespace, Any], object]]] = {
    "Skin contacts": ("contacts", NO_TRUTH, lambda _, x: Skin(STEPPED, contacts=x)),
    "Skin timeout": ("timeout_s", [*NO_TIME, 0, 0.0], lambda _, x: Skin(STEPPED, timeout_s=x)),
    "Skin port": ("port", NO_TEXT, lambda _, x: Skin(x)),
    "Skin nodes": ("nodes", [*NO_COUNT, None], lambda _, x: Skin(STEPPED, nodes=x)),
    "Skin mount": ("mount_xyz_m", NO_PLACE, lambda _, x: Skin(STEPPED, mount_xyz_m=x)),
    "open": ("patiently", NO_TRUTH, lambda g, x: g.skin.open(x)),
    "latest": ("max_age_s", NO_TIME, lambda g, x: g.skin.latest(x)),
    "telling": ("listener", NO_OBJECT, lambda g, x: g.skin.telling(x)),
    "press": ("objects are given one by one", NO_OBJECT, lambda g, x: g.skin.press(x)),
    "tare force": ("force", NO_TRUTH, lambda g, x: g.skin.tare(force=x)),
    "tare wait": ("wait_s", [*NO_TIME, None], lambda g, x: g.skin.tare(wait_s=x)),
    "Decoder": ("contacts", NO_TRUTH, lambda _, x: Decoder(contacts=x)),
    "feed": ("data", NO_BYTES, lambda g, x: g.decoder.feed(x, 0.0)),
    "feed at": ("t_host", [*NO_NUMBER, None, math.inf], lambda g, x: g.decoder.feed(b"", x)),
    "read_parameters": ("path", NO_TEXT, lambda _, x: read_parameters(x)),
    "read_recording": ("path", NO_TEXT, lambda _, x: list(read_recording(x))),
    "Body": ("path", NO_TEXT, lambda _, x: Body(x)),
    "Body only": ("only", NO_TEXT, lambda g, x: g.body(only=x)),
    "Body contacts": ("contacts", NO_TRUTH, lambda g, x: g.body(contacts=x)),
    "Body timeout": ("timeout_s", [*NO_TIME, 0], lambda g, x: g.body(timeout_s=x)),
    "dataset": ("dataset", NO_TEXT, lambda g, x: LiveObservation(x, g.skin)),
    "dataset name": ("not read", ["a\0b", "\ud800"], lambda g, x: LiveObservation(x, g.skin)),
    "parameters": ("dataset", NO_TEXT, lambda _, x: LiveObservation.parameters(x)),
    "skins": ("skins", NO_OBJECT, lambda _, x: LiveObservation.of(x)),
    "skins by name": ("skins", NO_OBJECT, lambda _, x: LiveObservation.of({"a": x})),
    "skins' names": ("a patch's name", NO_PATCH, lambda g, x: LiveObservation.of({x: g.skin})),
    "read now": ("now", NO_TRUTH, lambda g, x: g.seen.read(x)),
    "take": ("frame", NO_OBJECT, lambda g, x: g.seen.take(x)),
    "take patch": ("patch", [*NO_TEXT, "palm"], lambda g, x: g.seen.take(g.frame, x)),
    "take stamp": ("stamp_ns", NO_WHOLE, lambda g, x: g.seen.take(g.frame, "", x)),
    "take doubt": ("uncertainty_s", NO_TIME, lambda g, x: g.seen.take(g.frame, "", 1, x)),
    "at": ("time_ns", [*NO_WHOLE, None], lambda g, x: g.seen.at(x)),
    "SkinBatch": ("config", NO_OBJECT, lambda _, x: SkinBatch(x, 1)),
    "envs": ("envs", [*NO_COUNT, 0, None], lambda g, x: g.batch(x)),
    "simulator": ("simulator|of the form sim", [*NO_TEXT, "x"], lambda g, x: g.batch(1, x)),
    "delay_frames": ("delay_frames", NO_COUNT, lambda g, x: g.batch(1, delay_frames=x)),
    "tared": ("tared", NO_TRUTH, lambda g, x: g.batch(1, tared=x)),
    "begin": ("like", NO_ARRAY, lambda g, x: g.batch(1).begin(x)),
    "begin heard": ("heard", NO_TRUTH, lambda g, x: g.batch(1).begin(np.zeros(()), x)),
    "pressure": ("pressure_pa", NO_PRESSURE, lambda g, x: g.begun.step(g.state, x, g.idle)),
    "noise": ("deviates", NO_NOISE, lambda g, x: g.begun.step(g.state, g.idle, x)),
    "step state": ("state", [*NO_OBJECT, (), "o"], lambda g, x: g.begun.step(x, g.idle)),
    "step other's": ("state", [()], lambda g, _: g.begun.step(g.other, g.idle, g.idle)),
    "reset": ("done", NO_DONE, lambda g, x: g.begun.reset(*[g.state] * 2, x)),
    "other's": ("fresh", [()], lambda g, _: g.begun.reset(g.state, g.other, np.zeros(2, bool))),
    "BatchCover": ("layout", NO_OBJECT, lambda _, x: BatchCover(x)),
    "BatchCover place": ("position_m", NO_PLACES, lambda g, x: g.covers.pressure_pa(BALL, x)),
    "radius": ("radius_m", NO_SIZE, lambda _, x: Sphere(radius_m=x, **AT)),
    "length": ("length_m", NO_SIZE, lambda _, x: Cylinder(radius_m=1, length_m=x, **AT)),
    "size": ("size_m", [*NO_PLACE, (1, 0, 1)], lambda _, x: Box(size_m=x, **AT)),
    "stiffness": ("stiffness_pa_per_m", NO_STIFFNESS, lambda _, x: ball(stiffness_pa_per_m=x)),
    "position": ("position_m", NO_PLACE, lambda _, x: ball(position_m=x)),
    "orientation": ("orient|not a rotation", NO_TURN, lambda _, x: ball(orientation_xyzw=x)),
    "heights": ("heights_m", NO_HEIGHTS, lambda _, x: HeightMap(heights_m=x, cell_m=0.01, **AT)),
    "cover": ("positions_m|normals|areas_m2", NO_COVER, lambda g, x: Foundation(x, *g.places[1:])),
    "normals": ("normals", NO_NORMALS, lambda g, x: Foundation(g.places[0], x, g.places[2])),
    "cover's areas": ("areas_m2", NO_AREAS, lambda g, x: Foundation(*g.places[:2], x)),
    "aspect": ("aspect", [*NO_TIME, 0], lambda g, x: Foundation(*g.places, x)),
    "pressed": ("indenter", NO_OBJECTS, lambda g, x: g.cover.pressure_pa(x)),
    "at_force": ("force_n", [*NO_TIME, None], lambda g, x: at_force(g.cover, BALL, x)),
    "at_force cover": ("cover", NO_OBJECT, lambda _, x: at_force(x, BALL, 1.0)),
    "at_force along": ("along", NO_WAY, lambda g, x: at_force(g.cover, BALL, 1.0, x)),
    "pressed_pa along": ("along", NO_WAY, lambda g, x: pressed_pa(g.cover, [(BALL, 1.0, x)])),
    "pressed_pa": ("thing", NO_OBJECT, lambda g, x: pressed_pa(g.cover, [(x, 1.0, (0, 0, -1))])),
}


def ball(**changes: Any) -> Sphere:
    return Sphere(**{"radius_m": 1, **AT, **changes})


@pytest.mark.parametrize("case", CASES)
def test_wrong_kinds_are_refused_by_name(given: SimpleNamespace, case: str) -> None:
    name, wrong, call = CASES[case]
    for value in wrong:
        with pytest.raises(TactileError, match=name) as refused:
            call(given, value)
        assert len(str(refused.value)) < 300, "one clear sentence"


def test_numpys_scalars_arrays_and_paths_are_taken(given: SimpleNamespace) -> None:
    """And the skin that refused all of the above still works."""
    skin = Skin(STEPPED, nodes=np.int64(16), contacts=np.bool_(True), timeout_s=np.float32(2))
    assert skin.contacts is True and skin.timeout_s == 2.0 and skin.config.spec.nodes == 16
    assert Skin(Path("/dev/ttyACM9")).port == "/dev/ttyACM9"  # type: ignore[arg-type]
    mounted = Skin(STEPPED, mount_xyz_m=[np.float32(1), 0, np.float64(2)])
    assert mounted.parameters["mount_xyz_m"] == (1.0, 0.0, 2.0)
    assert given.body(timeout_s=None, only="a").skins.keys() == {"a"}
    assert len(read_parameters(Path("config/skin.yaml"))) > 5
    assert given.decoder.feed(np.zeros(3, np.uint8), np.float64(1)) == []  # type: ignore[arg-type]
    ball = Sphere(radius_m=np.array(0.02), position_m=np.array([0, 0, 0.019]))
    assert np.nanmax(given.skin.step(ball).pressure_pa) > 1e3
    strided = np.zeros((2, 32))[:, ::2]
    _, frame = given.begun.step(given.state, np.asfortranarray(given.idle), strided)
    assert frame.pressure_pa.shape == (2, 16)


# Calls in any order

EXAMPLES = {"Decoder": 25, "Skin": 20, "Body": 2, "LiveObservation": 20, "SkinBatch": 25}


@pytest.mark.parametrize("name", MACHINES)
def test_calls_in_any_order(name: str) -> None:
    try_orders(MACHINES[name], EXAMPLES[name])


def test_a_flush_before_a_digitizer_has_described_itself() -> None:
    decoder = Decoder(nodes=16)
    assert decoder.flush() == []
    assert decoder.feed(b"noise", 0.0) == []
    assert decoder.flush() == [] == decoder.flush()
