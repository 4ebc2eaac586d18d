# SPDX-License-Identifier: Apache-2.0

"""Programs that subscribe to show what a skin feels: terminal and Rerun."""
