# SPDX-License-Identifier: Apache-2.0

"""Starts the benchmark; apart from `bench`, for the processes of a pool cannot import this."""

import sys

if "--ablate" in sys.argv[1:]:
    from .ablate import main
else:
    from .bench import main

if __name__ == "__main__":
    main()
