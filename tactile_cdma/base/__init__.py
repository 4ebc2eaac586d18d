# SPDX-License-Identifier: Apache-2.0

"""Errors, files, untrusted text, interrupts: what every folder may use. Knows nothing of skins."""
