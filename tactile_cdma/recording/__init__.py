# SPDX-License-Identifier: Apache-2.0

"""Recordings and captures: files, offline decoding, tables and bags for other programs."""
