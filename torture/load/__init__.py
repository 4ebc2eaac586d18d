# SPDX-License-Identifier: Apache-2.0

"""A driver node under load, or left running: one rig for both."""
