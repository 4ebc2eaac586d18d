# SPDX-License-Identifier: Apache-2.0

"""Places taxels: layouts, neighbours, surfaces, coordinate frames."""
