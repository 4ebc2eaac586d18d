# SPDX-License-Identifier: Apache-2.0

"""Sensors that send no chips: whoever reads one hands in frames of codes or volts."""

from .taxel_source import TaxelFrame as TaxelFrame
from .taxel_source import TaxelSource as TaxelSource
