# SPDX-License-Identifier: Apache-2.0

"""The ROS 2 side: driver node, body node, viewers, rviz files. Nothing else imports rclpy."""
