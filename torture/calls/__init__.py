# SPDX-License-Identifier: Apache-2.0

"""Public calls in any order."""
