# SPDX-License-Identifier: Apache-2.0

"""Programs that subscribe to a skin and show it: in a terminal, in Rerun."""
