# SPDX-License-Identifier: Apache-2.0

"""Levels of the nodes → words: who spoke, which code, how sure; and the health of every node."""
