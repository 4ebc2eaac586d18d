# SPDX-License-Identifier: Apache-2.0

"""What the driver is put through before it is left running on a robot: `make torture`.

Each campaign is a package whose campaign.py has `run(plan)`, which yields one Outcome per kind of
fault; a slice of each is among the tests. docs/reliability.md says what was tried, and what came of
it.
"""
