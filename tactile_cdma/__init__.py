# SPDX-License-Identifier: Apache-2.0

"""Driver for large-area robot skin whose nodes share one wire by code division multiple access."""

from pkgutil import extend_path

# The generated message modules are installed beside, not inside, a source checkout:
# joining both paths lets `tactile_cdma.msg` be found from either.
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"
