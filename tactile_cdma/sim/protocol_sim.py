# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""sim:// for pyserial: a virtual digitizer that is opened like any other port."""

from __future__ import annotations

from ..virtual_port import VirtualPort
from .digitizer import VirtualDigitizer
from .options import SimOptions


class Serial(VirtualPort[VirtualDigitizer]):
    """A virtual digitizer, powered up by open() and down by close().

    Speed is set by the URL's option. open() raises SpecError for a bad one.
    """

    READ_AHEAD = 4096  # to make more takes long

    def reset_input_buffer(self) -> None:
        """Discard what has arrived and was not read."""
        with self._changed:
            digitizer = self._opened()
            digitizer.advance(0)
            digitizer.take(digitizer.pending)

    def _made(self, url: str) -> VirtualDigitizer:
        return VirtualDigitizer(SimOptions.from_url(url))

    def _receive(self, device: VirtualDigitizer, data: bytes) -> None:
        device.receive(data)
