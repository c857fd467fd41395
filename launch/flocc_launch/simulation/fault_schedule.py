"""A scenario's timeline of faults, carried out on a simulated swarm."""

from collections.abc import Iterable
from dataclasses import replace
from typing import assert_never

from flocc_agent.radio import Blackout, LinkParameters, Partition, RadioParameters
from flocc_launch.scenarios.scenario import Fault, FaultKind, LinkFault
from flocc_launch.simulation.swarm import Swarm


def schedule(swarm: Swarm, faults: Iterable[Fault]) -> None:
    """Enter every fault into the swarm's agenda."""
    for fault in faults:
        swarm.agenda.at(fault.at_s, lambda fault=fault: inject(swarm, fault))  # type: ignore[misc]


def inject(swarm: Swarm, fault: Fault) -> None:
    """Let one fault happen now."""
    match fault.kind:
        case FaultKind.KILL:
            for name in fault.robots:
                kill(swarm, name, fault.value)
        case FaultKind.RESTART:
            for name in fault.robots:
                restart(swarm, name, fault.disk_lost)
        case FaultKind.START:
            for name in fault.robots:
                if not swarm.stations[name].running:
                    swarm.start(name)
        case FaultKind.LEAVE:
            for name in fault.robots:
                swarm.leave(name)
        case FaultKind.MUTE:
            swarm.network.muted[fault.message or ""] = fault.value or 0.0
        case FaultKind.CALM:
            calm(swarm)
        case FaultKind.SLOW:
            for name in fault.robots:
                swarm.stations[name].workers.slowness = fault.value or 1.0
        case _:
            swarm.radio.parameters = changed(swarm.radio.parameters, fault.kind, fault, swarm.agenda.now_s)


def kill(swarm: Swarm, name: str, effects: float | None) -> None:
    """Cut a robot's power now, or in the middle of its next step that wants more than so many effects."""
    if effects is None:
        swarm.kill(name)
    else:
        swarm.stations[name].dies_after = int(effects)


def restart(swarm: Swarm, name: str, disk_lost: bool) -> None:
    """Switch a robot on again, after killing it if need be."""
    swarm.kill(name)
    if disk_lost:
        swarm.lose_disk(name)
    swarm.start(name)


def calm(swarm: Swarm) -> None:
    """From now on nothing goes wrong any more."""
    swarm.radio.parameters = RadioParameters(range_m=swarm.radio.parameters.range_m)
    swarm.network.muted.clear()
    for station in swarm.stations.values():
        station.workers.slowness = 1.0


def changed(radio: RadioParameters, kind: LinkFault, fault: Fault, now_s: float) -> RadioParameters:
    """The links after a fault."""
    match kind:
        case FaultKind.PARTITION:
            return replace(radio, partitions=(Partition(fault.groups, now_s),))
        case FaultKind.BLACKOUT:
            return replace(radio, blackouts=(*radio.blackouts, Blackout(fault.robots, now_s)))
        case FaultKind.HEAL:
            return radio.healed()
        case FaultKind.LOSS:
            return _every_link(radio, loss_ratio=fault.value or 0.0)
        case FaultKind.LATENCY:
            return _every_link(radio, latency_s=fault.value or 0.0)
        case FaultKind.RANGE:
            return replace(radio, range_m=fault.value or None)
        case _:
            assert_never(kind)


def _every_link(radio: RadioParameters, **values: float) -> RadioParameters:
    def better(link: LinkParameters) -> LinkParameters:
        return replace(link, **values)  # type: ignore[arg-type]

    overrides = tuple(replace(override, link=better(override.link)) for override in radio.overrides)
    return replace(radio, link=better(radio.link), overrides=overrides)
