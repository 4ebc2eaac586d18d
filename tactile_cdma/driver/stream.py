# SPDX-License-Identifier: Apache-2.0

"""Says what a stream has come to, and where its frames were decided; see compiled_stream.py."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from ..framing.timing import FrameLevels
from ..wire.messages import Received
from .clock import PassedPacket


@dataclass(slots=True)
class Decisions:
    """Where frames were decided, accepted or not; every number only grows.

    compiled: in the kernel. in_python: by the reason why not there. words_in_python: frames whose
    words were read there, wherever it was decided that they are frames.
    """

    compiled: int = 0
    in_python: Counter[str] = field(default_factory=Counter)
    words_in_python: int = 0

    @property
    def total(self) -> int:
        return self.compiled + self.in_python.total()

    @property
    def python_share(self) -> float:
        """Share of all that was decided in Python, 0…1."""
        return self.in_python.total() / max(1, self.total)

    @property
    def reasons(self) -> str:
        """Why frames were decided in Python, and how many for that: the most frequent first."""
        return ", ".join(f"{reason} {count}" for reason, count in self.in_python.most_common())

    def since(self, before: Decisions) -> Decisions:
        """Those since a moment; `before` is what this method gave then for none before."""
        in_python = self.in_python.copy()  # whose reasons stay, while another thread adds some
        return Decisions(
            self.compiled - before.compiled,
            in_python - before.in_python,
            self.words_in_python - before.words_in_python,
        )


class Event(NamedTuple):
    """What a stream has come to.

    passed: packets of samples that were accepted since the event before. frame: one that they
    completed. packet: one that is for others; one of samples has to be answered by `place`.
    needs_bytes: there is nothing else in the bytes so far.
    t_host, backlog: when the last bytes were read, s, host's monotonic clock; whether they waited.
    """

    passed: list[PassedPacket]
    frame: FrameLevels | None
    packet: Received | None
    needs_bytes: bool
    t_host: float
    backlog: bool
