# SPDX-License-Identifier: Apache-2.0

"""Fuzzing: every reader of untrusted bytes as a function that a fuzzer can call.

    seeds ──▶ mutations (atheris, hypothesis, test/corpus) ──▶ target ──▶ Find or None

`python -m torture.fuzz` searches on all cores. campaign.py runs a slice of it, and what no fuzzer
finds: files that exhaust memory, endless garbage, storms on the sync line, languages that differ.
"""
