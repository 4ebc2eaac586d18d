# SPDX-License-Identifier: Apache-2.0

"""What is soldered and programmed: a node's memory, its programmer, the summing amplifier."""
