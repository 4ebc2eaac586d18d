# SPDX-License-Identifier: Apache-2.0

"""What nodes send: the shape of a frame, Hadamard code books, and correlation with their rows."""
