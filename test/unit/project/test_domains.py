# SPDX-License-Identifier: Apache-2.0

"""Test runs beside each other do not hear each other."""

import os
import subprocess
import sys

from test.support.domains import own_domain

ANOTHER = "from test.support.domains import own_domain; print(own_domain())"


def test_no_domain_is_given_twice() -> None:
    mine = {own_domain(str(key)) for key in range(5)}
    assert len(mine) == 5 and own_domain() == int(os.environ["ROS_DOMAIN_ID"]) not in mine
    for _ in range(3):
        found = subprocess.run([sys.executable, "-c", ANOTHER], capture_output=True, check=True)
        assert int(found.stdout) not in mine | {own_domain()}
