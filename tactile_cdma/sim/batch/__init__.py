# SPDX-License-Identifier: Apache-2.0

"""Many equal skins at once, without the line, for reinforcement learning.

    poses, forces ──▶ cover ──▶ pressures ──▶ skin_batch ──▶ what the drivers would publish

Needs array-api-compat, the extra `learn`.
"""

from .cover import BatchCover
from .skin_batch import BatchFrame, BatchState, SkinBatch

__all__ = ["BatchCover", "BatchFrame", "BatchState", "SkinBatch"]
