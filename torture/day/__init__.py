# SPDX-License-Identifier: Apache-2.0

"""A day of packets in minutes."""
