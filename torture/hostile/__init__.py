# SPDX-License-Identifier: Apache-2.0

"""Bytes and files that mean harm."""
