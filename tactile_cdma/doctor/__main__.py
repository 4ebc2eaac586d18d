# SPDX-License-Identifier: Apache-2.0

"""`python -m tactile_cdma.doctor`: runs even if packages that tactile_cdma needs are missing."""

import argparse
import sys

from .command import add_arguments, run

parser = argparse.ArgumentParser(prog="python -m tactile_cdma.doctor")
add_arguments(parser)
sys.exit(run(parser.parse_args()))
