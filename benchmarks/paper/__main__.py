# SPDX-License-Identifier: Apache-2.0

"""Starts the benchmark."""

from .bench import main

if __name__ == "__main__":
    main()
