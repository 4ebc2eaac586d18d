# SPDX-License-Identifier: Apache-2.0

"""The ROS 2 side: driver node, body node, viewers, bag, rviz files. Nothing else imports rclpy."""
