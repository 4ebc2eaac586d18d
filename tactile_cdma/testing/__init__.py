# SPDX-License-Identifier: Apache-2.0

"""For users' own tests: a simulated skin as pytest fixtures, with and without ROS."""
