# SPDX-License-Identifier: Apache-2.0

"""What workers of pytest-xdist begin with, and what one that dies has failed: a test, no more."""

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadGroupScheduling, Scheduling
from xdist.workermanage import WorkerController

WAITING = "ros/"
"""Tests in a folder of this name wait most of their time, for other processes and real time."""
_died = pytest.StashKey[bool]()


class Groups(LoadGroupScheduling):
    """As --dist loadgroup, which gives a test that ended its worker to the next one.

    There it ends that one, too, until all are gone and pytest waits for ever. Every other worker
    begins with the tests that wait, so that what computes has the cores meanwhile.
    """

    def _assign_work_unit(self, node: WorkerController) -> None:
        waits = bool(self.nodes.index(node) % 2)
        for unit, tests in self.workqueue.items():
            if (WAITING in next(iter(tests))) == waits:
                self.workqueue.move_to_end(unit, last=False)
                break
        super()._assign_work_unit(node)

    def remove_node(self, node: WorkerController) -> str | None:
        units = self.assigned_work.pop(node)
        left = [(unit, test) for unit in units.values() for test, done in unit.items() if not done]
        if not left:
            return None
        unit, lethal = left[0]
        unit[lethal] = True
        self.workqueue.update({k: unit for k, unit in units.items() if not all(unit.values())})
        for other in self.assigned_work:
            self._reschedule(other)
        return lethal

    def _reschedule(self, node: WorkerController) -> None:
        """One that took a dead one's place is served once it has collected its tests."""
        if node in self.registered_collections:
            super()._reschedule(node)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Have workers begin with what takes long, so that none of it is left alone in the end."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling | None:
    return Groups(config, log) if config.getvalue("dist") == "loadgroup" else None


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: WorkerController, error: object | None) -> None:
    if error:
        node.config.stash[_died] = True


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """One that dies after its last test has failed that of no other."""
    if session.config.stash.get(_died, False) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
