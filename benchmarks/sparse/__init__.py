# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: `__main__` has what is certain and what it costs, `hug` everybody at once."""
