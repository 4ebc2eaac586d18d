"""Which taxels hang together: connected components of a part of the skin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def connected(taxels: NDArray[np.intp], beside: NDArray[np.intp]) -> NDArray[np.intp]:
    """Which of some taxels hang together: (k,) labels, 0…c − 1 in the order of first taxels.

    taxels: (k,) int, rising. beside: (m, t) int, the neighbours of all t taxels, a column each,
    filled up with the taxel itself.

    Trees of taxels grow together along the links between them: in each round every root that is
    linked to lower ones hangs itself below the lowest, the trees are flattened, and links now
    within a tree are dropped. (A form of Shiloach & Vishkin, An O(log n) parallel connectivity
    algorithm, 1982.)
    """
    own = np.arange(len(taxels))
    among = np.full(beside.shape[1], -1)
    among[taxels] = own
    low = among[beside[:, taxels]]
    links = (low >= 0) & (low < own)  # each from one end
    high, low = links.nonzero()[1], low[links]
    root = own
    while len(low):
        above = root.copy()
        np.minimum.at(above, high, low)
        while not np.array_equal(root, above):
            root, above = above, above[above]
        first, second = root[low], root[high]
        apart = first != second
        first, second = first[apart], second[apart]
        low, high = np.minimum(first, second), np.maximum(first, second)
    return np.asarray((np.cumsum(root == own) - 1)[root])
