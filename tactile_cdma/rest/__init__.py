# SPDX-License-Identifier: Apache-2.0

"""Tare and drift of a running skin, kept on file from one start to the next."""
