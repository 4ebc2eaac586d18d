# SPDX-License-Identifier: Apache-2.0

"""The node of a whole body: the patches of many drivers in one frame."""
