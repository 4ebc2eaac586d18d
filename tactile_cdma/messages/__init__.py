# SPDX-License-Identifier: Apache-2.0

"""Our ROS messages as data, without ROS: what their fields hold."""
