# SPDX-License-Identifier: Apache-2.0

"""Samples → levels: where frames start and how long chips are, from marks or the waveform."""
