# SPDX-License-Identifier: Apache-2.0

"""A Shadow Hand in MuJoCo holds an egg: six skins, on its palm and five fingertips.

    pip install mujoco; pip install --no-deps gymnasium-robotics    # the hand's model
    .venv/bin/python examples/mujoco_hand.py

The hand closes on the egg. With every frame of the skins 16 ms of physics pass; now and then the
force that each skin feels is printed, with the physics' own in brackets, N.
"""

from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
from mujoco_skin import MujocoSkin

from tactile_cdma import Skin
from tactile_cdma.places.poses import Pose

PORT, FRAME_MS, FRAMES, SHOWN = "sim://?scene=external&speed=0&threshold=0", 16.0, 150, 25
TIP = Path(__file__).with_name("fingertip.yaml")
CLOSED = 0.6
FINGERS = ("ff", "mf", "rf", "lf", "th")
OUT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""On the palm's side of its bodies, which is −y: x as theirs, y along the finger."""


def hand() -> mujoco.MjModel:
    """The model that gymnasium-robotics has of it, and of an egg."""
    package = find_spec("gymnasium_robotics")
    if package is None or not package.submodule_search_locations:
        raise SystemExit("mujoco_hand: pip install --no-deps gymnasium-robotics")
    folder = Path(package.submodule_search_locations[0])
    return mujoco.MjModel.from_xml_path(str(folder / "envs/assets/hand/manipulate_egg.xml"))


def skins(model: mujoco.MjModel) -> dict[str, tuple[MujocoSkin, Skin]]:
    """By name: where each skin is in the physics, and its driver, not open yet."""
    palm = Skin(PORT, nodes=24, rows=6, columns=4, pitch_mm=[15.0, 16.0], frame_period_ms=FRAME_MS)
    covered = ["robot0:C_palm0", "robot0:C_palm1"]  # one body, several geoms
    at_m = np.array([0.011, -0.0111, 0.038])
    found = {"palm": (MujocoSkin(model, covered, palm.layout, Pose(OUT, at_m)), palm)}
    for finger in FINGERS:
        radius_m = float(model.geom(f"robot0:C_{finger}distal").size[0])
        skin = Skin(PORT, nodes=12, frame_period_ms=FRAME_MS, layout_file=str(TIP))
        pose = Pose(OUT, np.array([0.0, -radius_m, 0.013]))
        found[finger] = MujocoSkin(model, f"robot0:{finger}distal", skin.layout, pose), skin
    return found


def main() -> None:
    model = hand()
    data, low_high = mujoco.MjData(model), model.actuator_ctrlrange
    steps = round(1e-3 * FRAME_MS / model.opt.timestep)
    on_hand = skins(model)
    with ExitStack() as stack:
        for _, skin in on_hand.values():
            stack.enter_context(skin)
        for frame in range(FRAMES):
            share = CLOSED * min(1.0, max(0.0, frame / FRAMES - 0.2) * 2)
            data.ctrl[:] = low_high[:, 0] + share * np.ptp(low_high, axis=1)
            mujoco.mj_step(model, data, steps)
            said = []
            for name, (place, skin) in on_hand.items():
                load_n = skin.step(*place.objects(data)).pressure_pa * skin.layout.areas_m2
                felt_n = float(np.linalg.norm(load_n @ skin.layout.normals))
                said.append(f"{name} {felt_n:.2f} ({sum(place.forces_n(data).values()):.2f})")
            if (frame + 1) % SHOWN == 0:
                print(f"{(frame + 1) * FRAME_MS / 1e3:.1f} s:", ", ".join(said))


if __name__ == "__main__":
    main()
