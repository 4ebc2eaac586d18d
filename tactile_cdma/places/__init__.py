# SPDX-License-Identifier: Apache-2.0

"""Where taxels are: layouts and their files, neighbours, surfaces, coordinate frames."""
