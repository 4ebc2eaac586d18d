# SPDX-License-Identifier: Apache-2.0

"""Words → pressure: calibration, dynamics, tare, drift, stuck nodes, contacts."""
