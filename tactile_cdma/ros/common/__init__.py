# SPDX-License-Identifier: Apache-2.0

"""What several ROS nodes share: QoS, conversion to messages, transforms, life as a process."""
