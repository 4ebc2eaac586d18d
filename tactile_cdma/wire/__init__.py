# SPDX-License-Identifier: Apache-2.0

"""Bytes ↔ packets ↔ port. The only user of pyserial."""
