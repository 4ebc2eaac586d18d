# SPDX-License-Identifier: Apache-2.0

"""Benchmarks of run time against error; each module is one command: `make bench-<module>`."""
