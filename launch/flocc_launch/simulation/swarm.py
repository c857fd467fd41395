"""A whole swarm on virtual time: stations, links, latents, and what happens to them over time."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from flocc_agent.backend import build_stepper
from flocc_agent.config import BackendMode
from flocc_agent.core.effects import Effect, Report
from flocc_agent.core.events import Event, Leaving
from flocc_agent.core.reports import Fact, LogForked
from flocc_agent.radio import Radio
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import AgentDied, AgentStopped
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.reporting import Reporter
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.agenda import Agenda
from flocc_launch.simulation.disk import Disk
from flocc_launch.simulation.virtual_fetches import LatentFetcher
from flocc_launch.simulation.virtual_network import Network
from flocc_launch.simulation.virtual_playback import Playback
from flocc_launch.simulation.virtual_robot import Clock, Station, Surroundings
from flocc_launch.simulation.virtual_workers import Eyes, Optimiser, VirtualWorkers, WorkTimes
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, Message

Observer = Callable[[Station, Event | None, list[Effect]], None]

POSITION_PERIOD_S = 0.5
LINKS, WORK, BOOTS, AIR = 1, 2, 3, 4
"""Purposes of generators, so that one more draw for one thing changes no other."""


@dataclass(frozen=True, slots=True)
class Equipment:
    """What all robots of a swarm carry.

    Attributes:
        eyes: Perception.
        optimiser: Of pose graphs.
        times: How long workers take.
        opened: A saved map; None: there is none.
        map_fixed: It does not move.
        lives: Robot -> the incarnation with which it begins, where that is not the first.
    """

    eyes: Eyes
    optimiser: Optimiser
    times: WorkTimes = field(default_factory=WorkTimes)
    opened: MapFolder | None = None
    map_fixed: bool = False
    lives: Mapping[str, int] = field(default_factory=dict)

    def disk(self, own: LogId, latent_bytes_max: int) -> Disk:
        """A new disk, and the map beside it."""
        return Disk(own, latent_bytes_max, opened=self.opened, map_fixed=self.map_fixed)


class Swarm:
    """Robots, links and their clock.

    Attributes:
        agenda: The clock.
        radio: The links.
        stations: By name.
        told: What was reported, in the order in which it happened.
        observers: Told of every step of every station.
        forked: Logs of which two versions were seen; everybody keeps the one that he heard first.
    """

    def __init__(self, scenario: Scenario, playbacks: Mapping[str, Playback], equipment: Equipment, seed: int) -> None:
        self.scenario = scenario
        self.agenda = Agenda()
        self.radio = Radio(scenario.links().parameters(), np.random.default_rng([seed, LINKS]))
        self.network = Network(self.agenda, self.radio, self._receive, np.random.default_rng([seed, AIR]))
        self.stations: dict[str, Station] = {}
        self._named: dict[str, list[Station]] = {}
        self.told: list[Reported[Fact]] = []
        self.observers: list[Observer] = []
        self._equipment = equipment
        self._seed = seed
        self._fetcher = LatentFetcher(self.agenda, self.network, self._running, scenario.bandwidth_bytes_s)
        self._reporters: dict[str, Reporter] = {}
        self.forked: set[LogId] = set()
        self._lives = dict(equipment.lives)
        self._near: tuple[float | None, dict[str, list[str]]] | None = None
        self._around = Surroundings(
            self._broadcast, self._unicast, self._fetcher.fetch, self._observe, lambda station: self.kill(station.name)
        )
        for number, name in enumerate(sorted(playbacks)):
            self._add(name, number, playbacks[name])
        self._move()

    def run_until(self, end_s: float) -> None:
        """Let time pass."""
        self.agenda.run_until(end_s)

    def start(self, name: str) -> None:
        """Switch a robot on."""
        station = self.stations[name]
        if not station.disk.whole:
            self._begin_log(station)
        station.log = station.disk.own
        boot = int(np.random.default_rng([self._seed, BOOTS, *name.encode(), station.life]).integers(2**52))
        core = self.scenario.core.under(self.scenario.bandwidth_bytes_s)
        station.start(boot, core, self.scenario.backend.mode is BackendMode.DISTRIBUTED)

    def kill(self, name: str) -> None:
        """A robot dies; its disk stays."""
        station = self.stations[name]
        if station.running:
            station.kill()
            self._fetcher.forget(name)
            self.report(name, AgentDied(signal=9, scripted=True))

    def leave(self, name: str) -> None:
        """A robot stops in order."""
        station = self.stations[name]
        if station.running:
            station.handle(Leaving())
            station.kill()
            self._fetcher.forget(name)
            self.report(name, AgentStopped())

    def add_twin(self, name: str) -> None:
        """Somebody switches on a second robot under a name that is taken, with a disk of its own."""
        twin = f"{name}-twin"
        self._add(twin, len(self.stations), self.stations[name].playback)
        self._named[name] += self._named.pop(twin)
        self.stations[twin].log = LogId(name)
        self._begin_log(self.stations[twin])
        self._near = None

    def lose_disk(self, name: str) -> None:
        """A dead robot's disk is replaced; it comes back as a new incarnation."""
        station = self.stations[name]
        assert not station.running
        station.disk = self._equipment.disk(station.log, self.scenario.store.latent_bytes_max)
        self._begin_log(station)

    def copy_disk(self, name: str, until_s: float) -> None:
        """Copy a robot's disk; at a later time the copy takes its place, and the robot starts with it."""
        content = self.stations[name].disk.content()

        def go_back() -> None:
            self.kill(name)
            self.stations[name].disk.restore(content)
            self.stations[name].disk.went_back = True
            self.start(name)

        self.agenda.at(until_s, go_back)

    def mend(self, name: str) -> None:
        """A robot that lied is switched off, and comes back as it should be."""
        self.stations[name].lies = False
        if self.stations[name].running:
            self.kill(name)
            self.start(name)

    def flip_bit(self, name: str, number: int) -> None:
        """Damage a robot's disk while it is switched off for a moment."""
        self.kill(name)
        self.stations[name].disk.flip(number)
        self.start(name)

    def cut_power(self, name: str) -> None:
        """The power goes for a moment: the correction that was applied last is not safe on the disk."""
        disk = self.stations[name].disk
        self.kill(name)
        disk.correction, disk.frame_changed, disk.went_back = None, False, True
        self.start(name)

    def _begin_log(self, station: Station) -> None:
        """Another log, that no earlier life of this name had."""
        name = station.log.robot
        self._lives[name] = self._lives.get(name, 0) + 1
        station.disk.begin(LogId(name, self._lives[name]))
        station.log = station.disk.own

    def _end_log(self, station: Station) -> None:
        """As `flocc agent`: stop in order, put the log aside, whose true records others have, and begin another one."""
        if station.running:
            self.leave(station.name)
            station.disk.records.pop(station.log, None)
            station.disk.whole = False
            self.start(station.name)

    def report(self, name: str, fact: Fact) -> None:
        """Add a fact that is not the core's."""
        self.told.append(Reported(self.agenda.now_s, name, fact))

    def running(self) -> list[Station]:
        """Stations that are switched on, by name."""
        return [station for station in self.stations.values() if station.running]

    def _add(self, name: str, number: int, playback: Playback) -> None:
        robot = self.scenario.robot(name)
        rng = np.random.default_rng([self._seed, WORK, number])
        log = LogId(name, self._equipment.lives.get(name, 0))
        self.stations[name] = Station(
            name,
            log,
            robot.compute_class,
            playback,
            VirtualWorkers(
                self._equipment.eyes,
                self._equipment.optimiser,
                build_stepper(self.scenario.backend),
                self._equipment.times,
                rng,
                playback.hidden,
            ),
            self._equipment.disk(log, self.scenario.store.latent_bytes_max),
            Clock(robot.clock_offset_s, robot.clock_drift_ratio),
            self.agenda,
            self._around,
        )
        self._named[name] = [self.stations[name]]
        self._reporters[name] = Reporter(name, playback.T_body_camera, self.scenario.backend.steepness)
        self.agenda.at(robot.start_s, lambda: self._first_start(name))
        self._play(self.stations[name], robot.start_s)

    def _first_start(self, name: str) -> None:
        """Switch on, unless a fault did so or undid it before."""
        if self.stations[name].life == 0:
            self.start(name)

    def _play(self, station: Station, start_s: float) -> None:
        """Enter every keyframe, and where the robot is meanwhile."""
        playback, rate = station.playback, self.scenario.rate
        for k, capture in enumerate(playback.captures):
            at_s = start_s + (capture.stamp_s - playback.first_stamp_s) / rate
            self.agenda.at(at_s, lambda k=k: station.capture(k))  # type: ignore[misc]

    def _move(self) -> None:
        """Tell the radio where the robots are, as long as one of them moves."""
        moving = False
        for name, station in self.stations.items():
            since_s = max(self.agenda.now_s - self.scenario.robot(name).start_s, 0.0) * self.scenario.rate
            position_m = station.playback.position_m(since_s)
            if position_m is not None:
                self.radio.update_position(name, position_m)
                moving |= since_s <= station.playback.lasts_s()
        self._near = None
        if moving:
            self.agenda.after(POSITION_PERIOD_S, self._move)

    def _in_range(self, sender: str) -> list[str]:
        """Stations that the radio's range does not rule out; the radio itself decides."""
        range_m = self.radio.parameters.range_m
        if self._near is None or self._near[0] != range_m:
            self._near = (range_m, _near_each(list(self.stations), self.radio, range_m))
        return self._near[1][sender]

    def _broadcast(self, sender: Station, message: Message) -> None:
        self.network.send(sender.name, Envelope(sender.log, message), self._in_range(sender.name))

    def _unicast(self, sender: Station, to: str, message: Message) -> None:
        receivers = [station.name for station in self._named.get(to, ()) if station is not sender]
        self.network.send(sender.name, Envelope(sender.log, message), receivers)

    def _receive(self, receiver: str, envelope: Envelope) -> bool:
        return self.stations[receiver].receive(envelope)

    def _running(self, robot: str) -> Station | None:
        """The station that answers to a robot's name."""
        return next((station for station in self._named.get(robot, ()) if station.running), None)

    def _observe(self, station: Station, event: Event | None, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Report):
                if isinstance(effect.fact, LogForked):
                    self.forked.add(effect.fact.log)
                    if effect.fact.log == station.log:
                        self.agenda.after(0.0, lambda: self._end_log(station))
                self.told.append(self._reporters[station.name].reported(effect.fact, self.agenda.now_s))
        for observer in self.observers:
            observer(station, event, effects)


def _near_each(names: list[str], radio: Radio, range_m: float | None) -> dict[str, list[str]]:
    """Of each station the others that may be in range, those without a position among them."""
    positions = [radio.position_m(name) for name in names]
    points = np.array([(np.nan,) * 3 if position is None else position for position in positions])
    far_m = math.inf if range_m is None else range_m * (1.0 + 1e-9)
    apart_m = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = ~(apart_m > far_m)
    np.fill_diagonal(near, val=False)
    return {name: [names[k] for k in np.flatnonzero(row)] for name, row in zip(names, near, strict=True)}
