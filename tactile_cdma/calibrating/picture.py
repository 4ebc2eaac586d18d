# SPDX-License-Identifier: Apache-2.0

"""The picture beside a calibration file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..base.errors import CalibrationError
from ..base.named_file import naming


@contextmanager
def picture(path: Path, widths: Sequence[float]) -> Iterator[Any]:
    """Axes side by side, of these relative widths, that become a PNG at the end of the context.

    Raises CalibrationError where it cannot be written.
    """
    from matplotlib.figure import Figure  # slow to load, and needed here only

    figure = Figure(figsize=(15, 4.5), layout="constrained")
    yield figure.subplots(1, len(widths), width_ratios=widths)
    with naming(path, CalibrationError):
        figure.savefig(path, format="png", dpi=110)
