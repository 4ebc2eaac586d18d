# SPDX-License-Identifier: Apache-2.0

"""Hostile bytes and files."""
