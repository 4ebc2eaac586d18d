# SPDX-License-Identifier: Apache-2.0

"""Reads other curves while a stream goes on: those of many nodes in a process of their own."""

import pickle
import sys
import time
from dataclasses import replace
from subprocess import Popen
from tempfile import TemporaryFile

from ...base.errors import CalibrationError, TactileError
from ...base.interrupt import is_told_to_stop
from ...config.parameters import Values
from ...config.skin_config import SkinConfig
from ..common.process import WAKE_S

APART_NODES = 256
"""Nodes from which on a calibration file is read in another process; see recalibrated. Chosen:
fewer curves are read in less time than it takes to start a process."""
READER = """
import pickle, sys
sys.path[:] = pickle.load(sys.stdin.buffer)
from tactile_cdma.base.errors import TactileError
config, values = pickle.load(sys.stdin.buffer)
try:
    read = config.recalibrated(values)
except TactileError as error:
    read = error
pickle.dump(read, sys.stdout.buffer)
"""
"""Program that reads curves; files carry what it is told and answers. Python 3.11 waits for ever
where a worker of a ProcessPoolExecutor is killed before it has taken its task, and where
communicate() is called again before all of its input was written."""
READ_S = 120.0
"""Longest time for that, s. Chosen: ten times what the most nodes take, 12 s."""


def recalibrated(config: SkinConfig, values: Values) -> SkinConfig:
    """Return the result of config.recalibrated, without holding up a stream; raises TactileError.

    Thousands of curves are read in a process of their own: a second of Python in this one would
    have the driver's thread wait for up to 80 ms at a time.
    """
    if config.spec.nodes < APART_NODES:
        return config.recalibrated(values)
    end_s, name = time.monotonic() + READ_S, values["calibration_file"]
    try:
        with TemporaryFile() as given, TemporaryFile() as answer:
            given.write(b"".join(map(pickle.dumps, (sys.path, (config, values)))))
            given.seek(0)
            with Popen([sys.executable, "-c", READER], stdin=given, stdout=answer) as reader:
                try:
                    while reader.poll() is None:
                        if is_told_to_stop() or time.monotonic() > end_s:
                            raise CalibrationError(
                                f"{name}: not read in {READ_S:g} s; is its disk gone?"
                            )
                        time.sleep(WAKE_S)
                finally:
                    reader.kill()  # else one that hangs would be waited for
            answer.seek(0)
            written = answer.read()
    except OSError as error:
        raise CalibrationError(f"{name}: its reader cannot begin: {error}") from error
    if reader.returncode:
        raise CalibrationError(f"{name}: its reader was killed; is memory short?")
    read = pickle.loads(written)  # noqa: S301 - by our own program
    if isinstance(read, TactileError):
        raise read
    return replace(config, curve=read.curve, calibration=read.calibration)
