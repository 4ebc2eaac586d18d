# SPDX-License-Identifier: Apache-2.0

"""The port of a source, for pyserial: frames of taxels come as packets of a digitizer do."""

from ..wire.virtual_port import VirtualPort
from .source_digitizer import SourceDigitizer
from .taxel_source import open_source


class Serial(VirtualPort[SourceDigitizer]):
    """A source behind a digitizer's packets; open() and read() raise what the source raises."""

    @property
    def problem(self) -> str | None:
        """Tell why no frames come, if the source knows."""
        return self._opened().problem

    def close(self) -> None:
        """Close the source, too; closing twice is harmless."""
        device = self._device
        super().close()
        if device is not None:
            device.source.close()

    def reset_input_buffer(self) -> None:
        """Discard nothing: what was not read is of this opening."""
        self._opened()

    def _made(self, url: str) -> SourceDigitizer:
        return SourceDigitizer(open_source(url), url)

    def _receive(self, device: SourceDigitizer, data: bytes) -> None:
        device.receive(data)
