# SPDX-License-Identifier: Apache-2.0

"""A host that does not answer, on this machine."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def mute_host() -> Iterator[str]:
    """URL of a host that lets nobody in: its queue of connections is full."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        waiting = []
        try:
            with suppress(TimeoutError):
                while True:
                    waiting.append(socket.socket())
                    waiting[-1].settimeout(0.3)
                    waiting[-1].connect(server.getsockname())
            yield "socket://{}:{}".format(*server.getsockname())
        finally:
            for client in waiting:
                client.close()
