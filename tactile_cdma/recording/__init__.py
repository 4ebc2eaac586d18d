# SPDX-License-Identifier: Apache-2.0

"""Recordings and captures: files, offline decoding, bags for other programs."""
