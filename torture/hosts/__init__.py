# SPDX-License-Identifier: Apache-2.0

"""Several computers: namespaces as hosts, a bad network between them, clocks that disagree."""
