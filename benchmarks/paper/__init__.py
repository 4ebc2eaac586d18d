# SPDX-License-Identifier: Apache-2.0

"""The paper's figures and claims, made by this project: `make paper`.

Liu et al., "Design of scalable orthogonal digital encoding architecture for large-area flexible
tactile sensing in robotics", arXiv 2509.10888.

- `claims`: what the paper says, what was found here, and how the two compare.
- `sensor`: figure 6, by the simulated sensor.
- `waves`: figures 3(b) and 7, by the code book and by an emulated node's pin.
- `words`: figure 8, by `tactile-cdma decode` of a scope's capture (examples/scope.csv).
- `scaling`: frame time, wires and throughput over the number of nodes.
- `__main__`: draws and reports.
"""
