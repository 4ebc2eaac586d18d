# SPDX-License-Identifier: Apache-2.0

"""Hours in real time."""
