# SPDX-License-Identifier: Apache-2.0

"""Samples → frames: where they start, how long chips are, words and certificate."""
