# SPDX-License-Identifier: Apache-2.0

"""`make soak`: a soak of any length; ends with 1 if anything happened that must not happen."""

import argparse
import sys

from ..outcome import summary
from .campaign import soak

parser = argparse.ArgumentParser(prog="python -m torture.soak", description=__doc__)
parser.add_argument("--seconds", type=float, default=3600.0)
outcome = soak(parser.parse_args().seconds)
print(outcome.said)
print(summary([outcome]))
sys.exit(not outcome.good)
