# SPDX-License-Identifier: Apache-2.0

"""`python -m tactile_cdma.doctor`: runs even if packages that tactile_cdma needs are missing."""

import sys

from .command import main

sys.exit(main())
