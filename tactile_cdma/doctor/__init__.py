# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma doctor`: is this installation, or this port, sound, and if not, what to do."""
