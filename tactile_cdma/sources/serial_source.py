# SPDX-License-Identifier: Apache-2.0

"""The serial port behind a source: its URL is SCHEME://DEVICE?baud=… and more options."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

from ..config.parameters import BY_NAME, Parameter, parse_options
from ..wire.identity import scheme_of
from ..wire.port import Port
from .taxel_source import TaxelFrame

LIMITS = BY_NAME["baud"].limits


class SerialSource(ABC):
    """Reads bytes of a port and has `feed` make frames of them; without I/O but for `read`.

    options: those of its URL, by name. problem: as of a source.
    """

    BAUD: int
    """Baud rate where the URL says none."""
    full_scale_v: float | None = None

    def __init__(self, url: str, options: Iterable[Parameter] = ()) -> None:
        """Open the port; raises PortError, and SpecError for a wrong option."""
        scheme = f"{scheme_of(url)}://"
        device, _, query = url[len(scheme) :].partition("?")
        baud = Parameter("baud", self.BAUD, "baud rate", "baud", LIMITS)
        known = (baud, *options)
        self.options: dict[str, Any] = {one.name: one.default for one in known}
        self.options |= parse_options(query, known, scheme)
        self.problem: str | None = "no bytes come: is the board powered, and its program running?"
        self._port = Port(device, self.options["baud"])

    @abstractmethod
    def feed(self, data: bytes, t_host: float, nodes: int | None) -> list[TaxelFrame]:
        """Return the frames that these bytes complete, read at t_host; notes `problem`."""

    def read(self, nodes: int | None) -> Sequence[TaxelFrame]:
        """Wait up to 0.1 s for bytes; returns the frames that they complete."""
        data, t_host = self._port.read()
        return self.feed(data, t_host, nodes) if data else ()

    def close(self) -> None:
        self._port.close()
