# SPDX-License-Identifier: Apache-2.0

"""The batched skin beside touch sensors of other simulators: `make bench-rivals`."""
