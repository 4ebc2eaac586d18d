# SPDX-License-Identifier: Apache-2.0

"""Fault campaigns against the driver, the simulator and the firmware: `make torture`.

The campaign of a package is `run(plan)` in its campaign.py, which yields one Outcome per kind of
fault; a slice of each runs among the tests. docs/reliability.md has what was tried and the results.
"""
