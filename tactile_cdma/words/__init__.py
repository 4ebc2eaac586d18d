# SPDX-License-Identifier: Apache-2.0

"""What a word is, and from which limits on; the health of every node."""
