# SPDX-License-Identifier: Apache-2.0

"""Frames without marks: where frames start is seen by the gaps between them."""
