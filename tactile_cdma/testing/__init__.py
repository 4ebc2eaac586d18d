# SPDX-License-Identifier: Apache-2.0

"""Gives users' own tests a simulated skin as pytest fixtures, with and without ROS."""
