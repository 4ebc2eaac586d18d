# SPDX-License-Identifier: Apache-2.0

"""A source of one's own: a sensor whose maker's library hands out forces, here made up.

Any package makes it a port by an entry point; in its pyproject.toml:

    [project.entry-points."tactile_cdma.sources"]
    finger = "own_source:Finger"

Then it is a port like any other, here with four taxels at 100 Hz:

    python examples/own_source.py          # tries it without being installed
    tactile-cdma doctor 'finger://left'    # once it is
"""

import time

import numpy as np

from tactile_cdma.sources import TaxelFrame


class Finger:
    bits = None  # as the parameter says
    full_scale_v = 3.3  # its values are volts
    problem = None

    def __init__(self, url: str) -> None:
        self.made = 0

    def read(self, nodes: int | None) -> list[TaxelFrame]:
        time.sleep(0.01)  # the library would wait here
        self.made += 1
        volts = np.array([3.0, 2.5, 2.0, np.nan])  # NaN: this taxel was not read
        return [TaxelFrame(volts, time.monotonic(), number=self.made)]

    def close(self) -> None: ...


if __name__ == "__main__":
    print(Finger("finger://left").read(4)[0].values)
