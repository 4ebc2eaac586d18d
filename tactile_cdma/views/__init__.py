# SPDX-License-Identifier: Apache-2.0

"""Data prepared for display: heatmaps, clouds of points, curves, text for a terminal."""
