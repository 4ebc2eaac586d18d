# SPDX-License-Identifier: Apache-2.0

"""What several ROS nodes share: QoS, messages as bytes, transforms, executor, life as a process."""
