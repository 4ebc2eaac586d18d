# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: `frames` has what is certain, `hug` everybody at once, `__main__` what it costs."""
