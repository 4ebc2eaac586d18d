# SPDX-License-Identifier: Apache-2.0

"""The doctor by itself, python -m tactile_cdma.doctor: also where packages of ours are missing."""

import sys

from .command import main

sys.exit(main())
