# SPDX-License-Identifier: Apache-2.0

"""The services ~/tare, ~/mask and ~/save_calibration."""

import time
from collections.abc import Callable

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future
from std_srvs.srv import Trigger

from tactile_cdma.srv import Mask, Tare

from ...base.errors import Refusal, RestError, TactileError
from ...readings.baseline import ALL
from ...rest.rest_keeper import RestKeeper
from ..common.convert import ros_array
from ..common.nodes import STEADY

RETRY_S = 0.1
"""Interval of attempts to tare, s; chosen: short for whoever waits, and they cost little."""
MOST_WAIT_S = 600.0
"""Longest wait of a tare, s; chosen: nobody stays that long."""


class RestServices:
    """Offers a skin's RestKeeper to other nodes."""

    def __init__(self, node: LifecycleNode, keeper: Callable[[], RestKeeper | None]) -> None:
        """keeper: returns that of the skin; None while the node is not configured."""
        self._keeper, self._log, self._node = keeper, node.get_logger(), node
        self._group = ReentrantCallbackGroup()  # a tare that waits holds up nothing else
        node.create_service(Tare, "~/tare", self._tare, callback_group=self._group)
        node.create_service(Mask, "~/mask", self._mask)
        node.create_service(Trigger, "~/save_calibration", self._save)

    async def _tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        end_s = time.monotonic() + min(request.wait, MOST_WAIT_S)
        while True:
            try:
                if (keeper := self._keeper()) is None:
                    text = "not tared: the skin is not active; activate the node first"
                    raise RestError(text, Refusal.INACTIVE)
                is_forced = request.force and (ALL if request.all else True)
                response.message = keeper.clear() if request.clear else keeper.tare(is_forced)
                response.success = True
                break
            except RestError as error:
                response.message, response.reason = str(error), int(error.reason)
                if not error.reason.may_pass or not time.monotonic() < end_s:
                    self._log.warning(response.message)
                    break
            await self._pause()
        keeper = self._keeper()
        if response.success:
            response.reason = Tare.Response.REASON_NONE
        if keeper is not None and keeper.baseline is not None:
            layout, baseline = keeper.config.layout, keeper.baseline
            response.offset = ros_array(layout.of_nodes(baseline.tare_pa))
            response.drift = ros_array(layout.of_nodes(baseline.drift_v))
        return response

    def _pause(self) -> Future:
        """Return a future that is done after RETRY_S, while the node serves others."""
        future: Future = Future()

        def end() -> None:
            self._node.destroy_timer(timer)
            future.set_result(None)

        group = self._group
        timer = self._node.create_timer(RETRY_S, end, callback_group=group, clock=STEADY)
        return future

    def _mask(self, request: Mask.Request, response: Mask.Response) -> Mask.Response:
        self._do(response, "masked", lambda keeper: keeper.mask(request.nodes, request.clear))
        if (keeper := self._keeper()) is not None:
            masked = {*keeper.masked, *keeper.config.layout.masked, *keeper.config.masked}
            response.masked = sorted(masked)
        return response

    def _save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._do(response, "saved", lambda keeper: "saved {} and {}".format(*keeper.save()))
        return response

    def _do(
        self,
        response: Mask.Response | Trigger.Response,
        done: str,
        call: Callable[[RestKeeper], str],
    ) -> None:
        """Answer with what a call returns, or why it is not done."""
        try:
            if (keeper := self._keeper()) is None:
                raise RestError(f"not {done}: the node is not configured; configure it first")
            response.message, response.success = call(keeper), True
        except TactileError as error:
            response.message = str(error)
