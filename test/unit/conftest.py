# SPDX-License-Identifier: Apache-2.0

"""Fixtures of tests of many rooms."""

from test.support.command_line import printed, refused

__all__ = ["printed", "refused"]
