# SPDX-License-Identifier: Apache-2.0

"""Damaged bytes between digitizer and driver."""
