# SPDX-License-Identifier: Apache-2.0

"""Nodes with clocks of their own: measuring, following and separating them."""
