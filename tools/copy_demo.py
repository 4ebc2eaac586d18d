# SPDX-License-Identifier: Apache-2.0

"""Copy the demonstrator's image to a Pico: `make demo`.

A demonstrator, or the board with this firmware that PORT names, is told to restart as the USB drive
that takes images. Any other board, and a computer that mounts no drives by itself, needs a person.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import serial
from serial.tools.list_ports import comports

from tactile_cdma.wire.port import why_not_open

LABEL = "RPI-RP2"
"""Name of the drive, from the RP2040's boot ROM; INFO_UF2.TXT is a file on it."""
DEMONSTRATOR = "Tactile skin demonstrator"
"""Name of a demonstrator on USB. A digitizer may be a skin's: it is not replaced unasked."""
BAUD_OF_BOOTSEL = 1200
PATIENCE_S = 12.0
"""Time until a drive is mounted, s. Chosen: a desktop takes some seconds."""
BY_HAND = """\
to do by hand:
  1. unplug the Pico, hold its BOOTSEL button while plugging it in, let go
  2. copy {image}
     to the drive {label} that appears; the board then starts by itself
"""


def main() -> int:
    """Restart a board and copy the image, or say how; returns the exit code."""
    image, port = Path(sys.argv[1]).resolve(), sys.argv[2]
    drive = mounted()
    if drive is None and restarted(port):
        end_s = time.monotonic() + PATIENCE_S
        while drive is None and time.monotonic() < end_s:
            time.sleep(0.5)
            drive = mounted()
    if drive is None:
        print(BY_HAND.format(image=image, label=LABEL))
    else:
        try:
            (drive / image.name).write_bytes(image.read_bytes())
        except OSError as error:
            print(f"{error.filename or drive}: {error.strerror}", file=sys.stderr)
            return 1
        print(f"copied to {drive}; the board starts by itself")
    print("then: make run PARAMS=config/demo_skin.yaml PORT=/dev/ttyACM0")
    return 0


def mounted() -> Path | None:
    """Find where a board's drive is mounted."""
    for line in Path("/proc/mounts").read_text().splitlines():
        folder = Path(line.split()[1].encode().decode("unicode_escape"))
        if folder.name == LABEL and (folder / "INFO_UF2.TXT").exists():
            return folder
    return None


def restarted(port: str) -> bool:
    """Ask the board on a port, or the only demonstrator, to restart as a drive; whether one did."""
    ports = [port] if port else [p.device for p in comports() if p.product == DEMONSTRATOR]
    if len(ports) != 1:
        if ports:
            print(f"several demonstrators: PORT={ports[0]} or another, please")
        return False
    try:
        serial.Serial(ports[0], BAUD_OF_BOOTSEL).close()
    except (OSError, serial.SerialException) as error:
        print(f"{ports[0]} cannot be restarted: {why_not_open(error, ports[0])}")
        return False
    print(f"{ports[0]} restarts as a drive")
    return True


if __name__ == "__main__":
    sys.exit(main())
