# SPDX-License-Identifier: Apache-2.0

"""A running skin: decoding pipeline, conversation with the digitizer, the thread of both."""
