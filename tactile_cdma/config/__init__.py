# SPDX-License-Identifier: Apache-2.0

"""What a user sets: the table of parameters, and the configuration of one skin made from it."""
