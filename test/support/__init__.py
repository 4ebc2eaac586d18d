# SPDX-License-Identifier: Apache-2.0

"""What tests, benchmarks and torture share: signals, what nodes really sent, boards, clients."""
