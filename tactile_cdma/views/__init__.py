# SPDX-License-Identifier: Apache-2.0

"""Arrays for eyes: heatmaps, clouds of points, curves, text for a terminal."""
