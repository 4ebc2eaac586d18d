# SPDX-License-Identifier: Apache-2.0

"""Bytes ↔ packets ↔ port. `port.py` is the only user of pyserial."""
