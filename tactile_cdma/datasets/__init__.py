# SPDX-License-Identifier: Apache-2.0

"""Data to learn from: recordings and bags ──▶ tables, and episodes on one clock."""
