# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma calibrate`: known loads ──▶ points ──▶ curves ──▶ file."""
