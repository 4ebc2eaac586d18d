# SPDX-License-Identifier: Apache-2.0

"""Datasets in the layout of LeRobotDataset v3."""

INFO = "meta/info.json"
"""The file by which a folder is such a dataset."""
ABOUT = "meta/tactile.json"
"""What LeRobot's own files have no place for: taxels, calibrations, units, choices made."""
