"""The emulated radio's section; `flocc_agent.radio` is what it becomes."""

from typing import TYPE_CHECKING

from pydantic import Field

from flocc_agent.config.section import Section, inner

if TYPE_CHECKING:
    from flocc_agent.radio import LinkParameters, RadioParameters


class LinkConfig(Section):
    """The emulated quality of a link; the default is perfect. `flocc_agent.radio` says what each one does."""

    loss_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message is lost, independently of others."""
    burst_ratio: float = Field(0.0, ge=0, le=1)
    """Share of messages that fall into bursts of loss."""
    burst_messages_mean: float = inner(5.0, ge=1)
    """Mean length of such a burst, messages."""
    latency_s: float = Field(0.0, ge=0)
    """Least delay of a message."""
    jitter_s: float = Field(0.0, ge=0)
    """Further delay, uniform between 0 and this."""
    duplicate_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message arrives twice."""
    reorder_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message may be overtaken."""
    reorder_delay_s: float = inner(0.2, ge=0)
    """How long such a message is held back."""
    bandwidth_bytes_s: float | None = Field(None, gt=0, allow_inf_nan=True)
    """Capacity of each directed link; none, or inf, is unlimited."""
    queue_bytes_max: int = inner(4 * 1024 * 1024, ge=0)
    """What may wait for a link before messages are lost."""

    def link(self) -> "LinkParameters":
        """The same as the link model takes it."""
        from flocc_agent.radio import LinkParameters

        return LinkParameters(**{name: getattr(self, name) for name in LinkConfig.model_fields})


class LinkOverrideConfig(LinkConfig):
    """Another quality for links of one direction."""

    sender: str = "*"
    """Robot that speaks, '*' for any."""
    receiver: str = "*"
    """Robot that hears, '*' for any."""


class PartitionConfig(Section):
    """Groups that do not hear each other for a while; robots that no group names are one more group."""

    groups: tuple[tuple[str, ...], ...]
    """Names, group by group."""
    from_s: float = Field(0.0, ge=0)
    """Begin, seconds after the start of the run."""
    to_s: float = Field(float("inf"), gt=0, allow_inf_nan=True)
    """End, seconds after the start of the run."""


class BlackoutConfig(Section):
    """Robots whose radio is dead for a while."""

    robots: tuple[str, ...]
    """Their names."""
    from_s: float = Field(0.0, ge=0)
    """Begin, seconds after the start of the run."""
    to_s: float = Field(float("inf"), gt=0, allow_inf_nan=True)
    """End, seconds after the start of the run."""


class RadioConfig(LinkConfig):
    """The emulated radio: the quality of every link, exceptions, range, and scheduled outages."""

    range_m: float | None = Field(None, gt=0, allow_inf_nan=True)
    """Robots whose true positions are further apart do not hear each other; none, or inf, is unlimited."""
    overrides: tuple[LinkOverrideConfig, ...] = ()
    """Links of another quality; the first match counts."""
    partitions: tuple[PartitionConfig, ...] = ()
    """Scheduled separations."""
    blackouts: tuple[BlackoutConfig, ...] = ()
    """Scheduled silences."""

    def parameters(self) -> "RadioParameters":
        """The same as the link model takes it."""
        from flocc_agent.radio import Blackout, LinkOverride, Partition, RadioParameters

        return RadioParameters(
            link=self.link(),
            overrides=tuple(LinkOverride(o.sender, o.receiver, o.link()) for o in self.overrides),
            range_m=self.range_m,
            partitions=tuple(Partition(p.groups, p.from_s, p.to_s) for p in self.partitions),
            blackouts=tuple(Blackout(b.robots, b.from_s, b.to_s) for b in self.blackouts),
        )
