# SPDX-License-Identifier: Apache-2.0

"""Makes what a node is programmed with, and programs it."""
