# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma doctor`: checks an installation or a port, and says how to fix what is wrong."""
