# SPDX-License-Identifier: Apache-2.0

"""Skins as named numbers, and back, without LeRobot.

lerobot-record keeps numbers exactly, all in observation.state, and images as lossy video. So every
taxel is a number with a name, made of what `tactile-cdma export --samples last` calls it:
observation.tactile.skin, its element taxel_3, is tactile.skin.taxel_3.vel; with .valid and .age_s.
They are computed by the export's code, so that both kinds of dataset mean the same.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma import Body, LiveObservation, ObservationError, PortError, Skin, read_parameters

OBSERVATION = "observation."
GROUPS = "tactile.", "contacts.", "wrench."
SEEN = ".vel"
"""End of every name: lerobot-rollout of LeRobot 0.6 hands a policy no others but .pos, to which it
would move the robot when it ends."""
OPEN_S = 10.0
"""Longest wait for the first frame of every skin, s; chosen: a port opens within 2 s."""
LOOK_S = 0.05


class Touch:
    """The skins of a robot, by one parameter file or one body file.

    names: of the numbers that read() gives, in this order.
    Raises what Skin and Body raise for files that cannot be used.
    """

    def __init__(self, skin: str = "", body: str = "", contacts: bool = False) -> None:
        self._ends: Body | Skin
        if body:
            self._ends = Body(body, contacts=contacts)
            skins = self._ends.skins
        else:
            self._ends = Skin(**read_parameters(skin), contacts=contacts)
            skins = {self._ends.config.skin: self._ends}  # the export calls no name "skin"
        self._skins: Mapping[str, Skin] = skins
        self._observation = LiveObservation.of(skins)
        self.names = names_of(self._observation)
        self.is_open = False

    def open(self) -> None:
        """Open the ports, and wait for the first frame of each; raises PortError."""
        self._ends.open()
        self.is_open = True
        self._observation = LiveObservation.of(self._skins)
        ends_s = time.monotonic() + OPEN_S
        while True:
            try:
                self.read()
                return
            except ObservationError as error:
                if time.monotonic() > ends_s:
                    self.close()
                    raise PortError(str(error)) from None
            time.sleep(LOOK_S)

    def close(self) -> None:
        self.is_open = False
        self._ends.close()

    def read(self) -> dict[str, float]:
        """The present readings, at once; of a skin that stopped none is valid."""
        return flat(self._observation, self._observation.read(now=True))


def names_of(observation: LiveObservation) -> list[str]:
    """Of the numbers that an observation has."""
    return [
        f"{feature.removeprefix(OBSERVATION)}.{element}{SEEN}"
        for feature, elements in observation.elements.items()
        for element in elements
        if feature.startswith(OBSERVATION)
    ]


def flat(observation: LiveObservation, found: Mapping[str, NDArray[Any]]) -> dict[str, float]:
    """What an observation has found, as numbers by names_of; float32 stays exact."""
    arrays = [array for feature, array in found.items() if feature.startswith(OBSERVATION)]
    values = np.concatenate([array.ravel() for array in arrays]).tolist()
    return dict(zip(names_of(observation), values, strict=True))


def touch_of(names: Sequence[str], state: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """A dataset's observation.state, (…, n), as the features that the export gives it.

    names: of its elements, as in meta.features. What is of no skin stays observation.state.
    """
    found: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        feature = "state"
        if name.startswith(GROUPS):
            feature = name.removesuffix(SEEN).rpartition(".")[0]
        found.setdefault(OBSERVATION + feature, []).append(index)
    return {feature: state[..., indices] for feature, indices in found.items()}
