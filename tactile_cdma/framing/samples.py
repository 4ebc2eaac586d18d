# SPDX-License-Identifier: Apache-2.0

"""Samples of the line: blocks of a stream, a buffer of them, and their mean between instants."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.arrays import Floats, Floats32, Indices
from ..base.stage import stage
