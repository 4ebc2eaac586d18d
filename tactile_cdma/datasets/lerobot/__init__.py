# SPDX-License-Identifier: Apache-2.0

"""Datasets in the layout of LeRobotDataset v3."""
