# SPDX-License-Identifier: Apache-2.0

"""The firmware under hostile bytes."""
