# SPDX-License-Identifier: Apache-2.0

"""Every reader of files that users name, given every odd file."""
