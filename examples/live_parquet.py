# SPDX-License-Identifier: Apache-2.0

"""Logs every frame of a skin to Parquet while a live picture shows it.

    python examples/live_parquet.py sim:// touch.parquet --seconds 10
    python examples/live_parquet.py /dev/ttyACM0 touch.parquet --params config/wired_skin.yaml
    python examples/live_parquet.py 'replay://a.skin?speed=0' touch.parquet

Needs pyarrow (the extra [learn]). One thread logs the frames as they come, 78 per second; the
main thread draws the newest one, so that no frame waits for the picture. Ctrl-C ends it. The file
appears when the log ends, also by the end of a recording or the loss of the port. Without a screen
(MPLBACKEND=Agg), --picture FILE keeps the last picture. Afterwards:

    pandas.read_parquet("touch.parquet")["pressure_pa"].iloc[-1]     # (16,) Pa; NaN: no reading
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from tactile_cdma import Frame, PortError, Skin, read_parameters
from tactile_cdma.datasets.parquet_table import parquet_table

PICTURES_HZ = 10
FULL_SCALE_KPA = 50


def log(skin: Skin, output: Path, newest: deque[Frame], stop: threading.Event) -> int:
    """Write every frame until told to stop, or there are no more; returns how many."""
    taxels, frames = (len(skin.layout),), 0
    columns = {
        "unix_time_s": ("f8", ()),
        "sequence": ("u8", ()),
        "pressure_pa": ("f4", taxels),
        "status": ("u1", taxels),
    }
    about = {"port": skin.port, "digitizer": skin.source.digitizer}
    with parquet_table(output, columns, about) as table:
        try:
            for frame in skin:  # until a recording ends
                row = {
                    "unix_time_s": time.time() - (time.monotonic() - frame.t_host),
                    "sequence": frame.sequence,
                    "pressure_pa": frame.pressure_pa,
                    "status": frame.status,
                }
                table.add(row)
                newest.append(frame)
                frames += 1
                if stop.is_set():
                    break
        except PortError as error:
            if not frames:
                raise  # no file without a frame
            print(f"the log ends here: {error}", file=sys.stderr)
    return frames


def main() -> None:
    """Log and draw until the time is over."""
    parser = argparse.ArgumentParser(description="logs a skin to Parquet and shows it")
    parser.add_argument("port", help="device, sim:// or replay://FILE")
    parser.add_argument("output", type=Path, help="the Parquet file")
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    parser.add_argument("--params", help="parameter file of the skin; else 16 plain nodes")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--picture", type=Path, help="keep the last picture in this file")
    arguments = parser.parse_args()
    if arguments.output.exists() and not arguments.force:
        parser.error(f"{arguments.output}: exists already; --force overwrites it")

    parameters = read_parameters(arguments.params) if arguments.params else {}
    skin = Skin(**{**parameters, "port": arguments.port})
    shape = skin.layout.rows, skin.layout.columns
    figure, axes = plt.subplots()
    image = axes.imshow(np.full(shape, np.nan), vmin=0, vmax=FULL_SCALE_KPA)
    figure.colorbar(image, label="kPa")
    plt.show(block=False)

    newest: deque[Frame] = deque(maxlen=1)
    stop = threading.Event()
    with skin, ThreadPoolExecutor(1) as pool:
        logged = pool.submit(log, skin, arguments.output, newest, stop)
        end_s = time.monotonic() + arguments.seconds
        try:
            going = True
            while going:
                going = time.monotonic() < end_s and not logged.done()
                if newest:
                    image.set_data(newest[-1].pressure_pa.reshape(shape) / 1e3)
                    figure.canvas.draw()
                figure.canvas.flush_events()
                time.sleep(1 / PICTURES_HZ)
        except KeyboardInterrupt:
            pass  # the log is completed below
        finally:
            stop.set()
        print(f"frames={logged.result()} dropped={skin.dropped}")
    if arguments.picture:
        figure.savefig(arguments.picture)


if __name__ == "__main__":
    main()
