# SPDX-License-Identifier: Apache-2.0

"""All targets by name."""

from __future__ import annotations

from . import files, streams, texts

TARGETS = {target.name: target for target in (*streams.TARGETS, *files.TARGETS, *texts.TARGETS)}
