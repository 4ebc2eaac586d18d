# SPDX-License-Identifier: Apache-2.0

"""The driver node: one skin's topics, services, parameters and diagnostics."""
