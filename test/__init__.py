# SPDX-License-Identifier: Apache-2.0

"""Tests, and in `support` what they share with benchmarks and torture; never installed."""
