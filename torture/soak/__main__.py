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
