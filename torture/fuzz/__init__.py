# SPDX-License-Identifier: Apache-2.0

"""Hostile bytes: everything that reads bytes of others, as a function that a fuzzer can call.

    seeds ──▶ mutations (atheris, hypothesis, test/corpus) ──▶ target ──▶ Find or None

`python -m torture.fuzz` searches with all cores; torture/hostile.py is a slice of it.
"""
