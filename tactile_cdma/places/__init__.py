# SPDX-License-Identifier: Apache-2.0

"""Where taxels are: layouts, neighbours, surfaces, coordinate frames."""
