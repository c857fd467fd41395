"""Fetching latents between simulated robots: piece by piece, asked again when lost, going on where it was cut."""

from collections.abc import Callable

from flocc_agent.budget import Budget
from flocc_agent.core.effects import FetchLatent
from flocc_agent.core.events import LATENT_UNKNOWN, Event, LatentFetched, LatentFetchFailed
from flocc_agent.runtime.jobs import keep_fetched
from flocc_launch.simulation.agenda import Agenda
from flocc_launch.simulation.virtual_network import Network
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import KeyframeId

REQUEST_BYTES = 96
PIECE_BYTES = 256 * 1024
PIECE_TIMEOUT_S = 1.0
SHARED_BY = 4
"""A piece is given the time of so many on a slow link, since others use it too."""
PARTIAL_MAX = 16


class LatentFetcher:
    """One robot's fetches; pieces that arrived are kept in its memory."""

    def __init__(
        self,
        agenda: Agenda,
        network: Network,
        owner_of: Callable[[str], Station | None],
        bandwidth_bytes_s: float | None = None,
    ) -> None:
        """Start without fetches.

        Args:
            agenda: The clock.
            network: Carries requests and pieces.
            owner_of: The running station of a robot's name.
            bandwidth_bytes_s: Budget of each robot, None for none.
        """
        self._bandwidth_bytes_s = bandwidth_bytes_s
        self._budgets: dict[str, Budget] = {}
        self._agenda = agenda
        self._network = network
        self._station_of = owner_of
        self._arrived: dict[tuple[str, KeyframeId], int] = {}

    def fetch(self, asker: Station, job: FetchLatent) -> None:
        """Start a fetch; it ends in one LatentFetched or LatentFetchFailed, at the latest when its time is over."""
        fetch = _FetchUnderWay(self, asker, job)
        self._agenda.after(job.deadline_s, lambda: fetch.fail("deadline"))
        fetch.ask()

    def _pause_s(self, asker: Station) -> float:
        """How long a robot's next piece has to wait for its budget."""
        if self._bandwidth_bytes_s is None:
            return 0.0
        budget = self._budgets.setdefault(asker.name, Budget(self._bandwidth_bytes_s))
        return budget.pause_s(self._network.used_bytes(asker.name), self._agenda.now_s)

    def _progress(self, asker: Station, keyframe: KeyframeId) -> int:
        return self._arrived.get((asker.name, keyframe), 0)

    def _note(self, asker: Station, keyframe: KeyframeId, size: int) -> None:
        self._arrived[asker.name, keyframe] = size
        while len(self._arrived) > PARTIAL_MAX * 64:
            del self._arrived[next(iter(self._arrived))]

    def forget(self, station: str) -> None:
        """The robot died, and what had arrived of unfinished latents with it."""
        self._arrived = {key: size for key, size in self._arrived.items() if key[0] != station}


class _FetchUnderWay:
    """One fetch under way."""

    def __init__(self, fetcher: LatentFetcher, asker: Station, job: FetchLatent) -> None:
        self._fetcher = fetcher
        self._asker = asker
        self._job = job
        self._life = asker.life
        self._began_s = fetcher._agenda.now_s
        self._over = False

    def ask(self) -> None:
        """Ask for the next piece, and once more if it does not come."""
        holder = self._fetcher._station_of(self._job.holder)
        if self._dead() or holder is None:
            return
        pause_s = self._fetcher._pause_s(self._asker)
        if pause_s > 0.0:
            self._fetcher._agenda.after(pause_s, self.ask)
            return
        offset = self._fetcher._progress(self._asker, self._job.keyframe)
        self._fetcher._network.carry(
            self._asker.name, holder.name, "latent-request", 0, REQUEST_BYTES, lambda: self._serve(holder, offset)
        )
        lasts_s = self._fetcher._network.lasts_s(holder.name, self._asker.name, PIECE_BYTES)
        self._fetcher._agenda.after(PIECE_TIMEOUT_S + SHARED_BY * lasts_s, lambda: self._ask_again(offset))

    def fail(self, reason: str) -> None:
        """The fetch came to its end without the latent."""
        self._finish(LatentFetchFailed(self._job.keyframe, self._job.holder, reason))

    def _ask_again(self, offset: int) -> None:
        if self._fetcher._progress(self._asker, self._job.keyframe) == offset:
            self.ask()

    def _serve(self, holder: Station, offset: int) -> bool:
        """At the holder: send a piece, or say that it is not there. Whether the holder is switched on."""
        if not holder.running:
            return False
        latent = holder.disk.latent(self._job.keyframe)
        size = 0 if latent is None else min(PIECE_BYTES, len(latent) - offset)
        self._fetcher._network.carry(
            holder.name,
            self._asker.name,
            "latent",
            size,
            REQUEST_BYTES + size,
            lambda: self._arrived(latent, offset, size),
        )
        return True

    def _arrived(self, latent: bytes | None, offset: int, size: int) -> bool:
        """At the asker: keep a piece, and ask for the next. Whether the asker is switched on."""
        running = self._asker.running
        self._take(latent, offset, size)
        return running

    def _take(self, latent: bytes | None, offset: int, size: int) -> None:
        fetcher, keyframe = self._fetcher, self._job.keyframe
        if self._dead() or fetcher._progress(self._asker, keyframe) != offset:
            return
        if latent is None:
            self.fail(LATENT_UNKNOWN)
            return
        fetcher._note(self._asker, keyframe, offset + size)
        if offset + size < len(latent):
            self.ask()
            return
        fetcher._arrived.pop((self._asker.name, keyframe), None)
        keep_fetched(keyframe, latent, self._asker.disk)
        self._asker.workers.stages.observe("fetch", fetcher._agenda.now_s - self._began_s)
        self._finish(LatentFetched(keyframe, self._job.holder))

    def _dead(self) -> bool:
        return self._over or self._asker.life != self._life

    def _finish(self, event: Event) -> None:
        if not self._dead():
            self._over = True
            self._asker.handle(event)
