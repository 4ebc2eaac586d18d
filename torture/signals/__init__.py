# SPDX-License-Identifier: Apache-2.0

"""Faults of nodes and of the analog line."""
