# SPDX-License-Identifier: Apache-2.0

"""The ROS 2 side: the driver node, messages, and a viewer. Nothing else imports rclpy."""
