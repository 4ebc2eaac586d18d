# SPDX-License-Identifier: Apache-2.0

"""ROS domains that no other run on this machine has."""

import os
import socket
from functools import cache

DOMAINS = 101
"""Domain ids that leave room below Linux's ephemeral ports."""
_claims: list[socket.socket] = []


@cache
def own_domain(key: str = "") -> int:
    """A domain of this process until it ends, from 1 on; another one for each key.

    It belongs to whoever has bound a socket of its name: as DDS by LOCALHOST, such names are known
    throughout a network namespace, and they are gone with their process.
    """
    for attempt in range(DOMAINS):
        domain = 1 + (os.getpid() + attempt) % DOMAINS
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0ros-domain-{domain}")
        except OSError:
            claim.close()
            continue
        _claims.append(claim)
        return domain
    raise RuntimeError(f"all {DOMAINS} ROS domains are taken by test runs on this machine")
