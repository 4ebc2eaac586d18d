# SPDX-License-Identifier: Apache-2.0

"""Recordings as ports: the bytes that were recorded come again, as they came or faster.

    file ──▶ player (when which bytes are due) ──▶ replay:// (protocol_replay)

pyserial finds `replay://` once 'tactile_cdma.replay' is in serial.protocol_handler_packages.
"""
