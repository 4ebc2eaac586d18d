# SPDX-License-Identifier: Apache-2.0

"""Ports and digitizers that go away and come back."""
