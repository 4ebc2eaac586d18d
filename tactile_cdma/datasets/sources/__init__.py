# SPDX-License-Identifier: Apache-2.0

"""What datasets are made of: recordings and bags, read as samples in the order of their time."""
