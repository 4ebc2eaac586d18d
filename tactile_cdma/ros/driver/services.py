# SPDX-License-Identifier: Apache-2.0

"""The services ~/tare and ~/save_calibration."""

from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import Trigger

from tactile_cdma.srv import Tare

from ...base.errors import RestError, TactileError
from ...rest.rest_keeper import RestKeeper
from ..common.convert import by_taxel


class RestServices:
    """Offers a skin's RestKeeper to other nodes."""

    def __init__(self, node: LifecycleNode, keeper: Callable[[], RestKeeper | None]) -> None:
        """keeper: returns that of the skin; None while the node is not configured."""
        self._keeper, self._log = keeper, node.get_logger()
        node.create_service(Tare, "~/tare", self._tare)
        node.create_service(Trigger, "~/save_calibration", self._save)

    def _tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        keeper = self._keeper()
        try:
            if keeper is None:
                raise RestError("not tared: the skin is not active; activate the node first")
            response.message = "tare and drift are forgotten"
            if request.clear:
                keeper.clear()
            else:
                response.message = str(keeper.tare(request.force))
            response.success = True
        except RestError as error:
            response.message = str(error)
            self._log.warning(response.message)
        if keeper is not None and keeper.baseline is not None:
            layout, baseline = keeper.config.layout, keeper.baseline
            response.offset = by_taxel(layout, baseline.tare_pa)
            response.drift = by_taxel(layout, baseline.drift_v)
        return response

    def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        keeper = self._keeper()
        try:
            if keeper is None:
                raise RestError("not saved: the node is not configured; configure it first")
            response.message = "saved {} and {}".format(*keeper.save())
            response.success = True
        except TactileError as error:
            response.message = str(error)
        return response
