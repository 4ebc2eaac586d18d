# SPDX-License-Identifier: Apache-2.0

"""What a node is programmed with: its memory, and the programmer."""
