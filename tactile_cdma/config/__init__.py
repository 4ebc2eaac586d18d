# SPDX-License-Identifier: Apache-2.0

"""Holds what a user sets: the table of parameters, and the configuration of one skin."""
