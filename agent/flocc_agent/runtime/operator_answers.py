"""What an agent answers an operator: its status with what keeps maps apart, and orders that disturb it."""

import asyncio
import json
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass

from flocc_agent.config import AgentConfig
from flocc_agent.core.reports import Fact
from flocc_agent.radio import Radio
from flocc_agent.runtime.chaos import BadOrder, disturbed, read_order
from flocc_agent.runtime.driver import Driver
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.evidence import evidence_of
from flocc_agent.runtime.facts import KilledByOrder
from flocc_agent.runtime.status import AgentStatus
from flocc_protocol.keys import Admin

KILL_AFTER_S = 0.2
"""Time for the answer to an operator's order to leave."""


@dataclass(frozen=True, slots=True)
class OperatorAnswers:
    """Answers of one agent, whose driver and radio may be others after each journey.

    Attributes:
        config: The agent's.
        clock_s: Seconds since the start of the run.
        report: Takes what is to be told.
        status: What the agent does now.
        driver: The running one.
        radio: The emulated links, None without.
        set_slowness: Makes the agent's work take that many times as long.
    """

    config: AgentConfig
    clock_s: Callable[[], float]
    report: Callable[[Reported[Fact]], None]
    status: Callable[[], AgentStatus]
    driver: Callable[[], Driver]
    radio: Callable[[], Radio | None]
    set_slowness: Callable[[float], None]

    def by_kind(self) -> dict[Admin, Callable[[bytes], bytes]]:
        """What answers each kind of request; orders only where the configuration allows them."""
        answers: dict[Admin, Callable[[bytes], bytes]] = {Admin.STATUS: self.tell_status}
        if self.config.transport.chaos:
            answers[Admin.CHAOS] = self.obey
        return answers

    def tell_status(self, _: bytes) -> bytes:
        """Tell the status, and what an operator may want to know of maps that have not merged."""
        driver, radio = self.driver(), self.radio()
        merging = evidence_of(driver.robot, self.config.core, driver.solved)
        if radio is not None:
            merging = merging.model_copy(update={"emulated": radio.parameters.emulated()})
        status = self.status().model_dump(mode="json")
        return json.dumps(
            {**status, "compute_class": self.config.compute_class, **merging.model_dump(mode="json")}
        ).encode()

    def obey(self, request: bytes) -> bytes:
        """Carry out an order, and say so."""
        try:
            order = read_order(request)
        except BadOrder as error:
            return str(error).encode()
        if not order.concerns(self.config.name):
            return b"not concerned"
        radio = self.radio()
        if radio is not None:
            radio.parameters = disturbed(radio.parameters, order, self.clock_s())
        if order.kind == "slow" and order.value is not None:
            self.set_slowness(order.value)
        if order.kind == "kill":
            self.report(Reported(self.clock_s(), self.config.name, KilledByOrder()))
            asyncio.get_running_loop().call_later(KILL_AFTER_S, os.kill, os.getpid(), signal.SIGKILL)
        return b"done"
