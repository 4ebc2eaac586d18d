# SPDX-License-Identifier: Apache-2.0

"""Words → pressure: calibration, tare, drift, stuck nodes, contacts."""
