# SPDX-License-Identifier: Apache-2.0

"""Fixtures of tests of many rooms."""

from test.support.command_line import done, refused

__all__ = ["done", "refused"]
