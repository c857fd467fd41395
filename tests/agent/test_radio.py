"""Claims on the link model: each knob does what its line says, and a seed repeats everything."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.radio import Blackout, LinkOverride, LinkParameters, Partition, Radio, RadioParameters

SEED = 7
MESSAGES = 20_000
PERFECT = LinkParameters()


def radio_of(link: LinkParameters = PERFECT, **others: object) -> Radio:
    return Radio(replace(RadioParameters(link=link), **others), np.random.default_rng(SEED))  # type: ignore[arg-type]


def sent(radio: Radio, count: int = MESSAGES, spacing_s: float = 0.1, size_bytes: int = 100) -> list[list[float]]:
    return [radio.transmit("r1", "r2", "log", size_bytes, i * spacing_s) for i in range(count)]


def test_a_perfect_link_delivers_at_once_and_in_order() -> None:
    assert sent(radio_of(), 100) == [[i * 0.1] for i in range(100)]


def test_only_default_parameters_are_perfect() -> None:
    assert RadioParameters().is_perfect
    assert not RadioParameters(range_m=5.0).is_perfect


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        (RadioParameters(), None),
        (RadioParameters(range_m=math.inf), None),
        (RadioParameters(link=LinkParameters(latency_s=0.1)), None),
        (RadioParameters(range_m=12.5), "a range of 12.5 m"),
        (RadioParameters(link=LinkParameters(loss_ratio=0.5, burst_ratio=0.5)), "75 % loss"),
        (RadioParameters(link=LinkParameters(bandwidth_bytes_s=1000.0)), "1000 bytes/s"),
        (
            RadioParameters(
                overrides=(LinkOverride("r1", "*", PERFECT),),
                partitions=(Partition((("r1",), ("r2",))),),
                blackouts=(Blackout(("r1",)),),
            ),
            "links of other qualities, partitions, blackouts",
        ),
    ],
)
def test_what_keeps_messages_back_is_said_in_words(parameters: RadioParameters, words: str | None) -> None:
    assert parameters.emulated() == words


def test_loses_the_given_share_independently() -> None:
    lost = [not arrivals for arrivals in sent(radio_of(LinkParameters(loss_ratio=0.3)))]
    assert np.mean(lost) == pytest.approx(0.3, abs=0.01)
    after_a_loss = [lost[i + 1] for i in range(len(lost) - 1) if lost[i]]
    assert np.mean(after_a_loss) == pytest.approx(0.3, abs=0.02)


def test_bursts_have_the_given_share_and_mean_length() -> None:
    link = LinkParameters(burst_ratio=0.2, burst_messages_mean=8.0)
    lost = [not arrivals for arrivals in sent(radio_of(link))]
    bursts = "".join("x" if gone else " " for gone in lost).split()
    assert np.mean(lost) == pytest.approx(0.2, abs=0.03)
    assert np.mean([len(burst) for burst in bursts]) == pytest.approx(8.0, rel=0.15)


def test_delays_between_latency_and_latency_plus_jitter() -> None:
    delays = [a[0] - i * 0.1 for i, a in enumerate(sent(radio_of(LinkParameters(latency_s=0.1, jitter_s=0.05))))]
    assert min(delays) >= 0.1 - 1e-9
    assert max(delays) <= 0.15 + 1e-9
    assert np.mean(delays) == pytest.approx(0.125, abs=0.001)


def test_jitter_alone_never_reorders() -> None:
    arrivals = [a[0] for a in sent(radio_of(LinkParameters(jitter_s=1.0)))]
    assert arrivals == sorted(arrivals)


def test_the_reordered_share_is_overtaken() -> None:
    link = LinkParameters(reorder_ratio=0.1, reorder_delay_s=0.25)
    arrivals = [a[0] for a in sent(radio_of(link))]
    late = sum(arrivals[i] > arrivals[i + 1] for i in range(len(arrivals) - 1))
    assert late / len(arrivals) == pytest.approx(0.09, abs=0.02)


def test_duplicates_the_given_share() -> None:
    copies = [len(arrivals) for arrivals in sent(radio_of(LinkParameters(duplicate_ratio=0.25)))]
    assert set(copies) == {1, 2}
    assert np.mean(copies) == pytest.approx(1.25, abs=0.01)


def test_bandwidth_spaces_messages_by_their_size() -> None:
    radio = radio_of(LinkParameters(bandwidth_bytes_s=1000.0))
    assert [radio.transmit("r1", "r2", "log", 500, 0.0) for _ in range(3)] == [[0.5], [1.0], [1.5]]
    assert radio.transmit("r1", "r2", "log", 500, 10.0) == [10.5]


def test_a_full_queue_drops_and_counts() -> None:
    radio = radio_of(LinkParameters(bandwidth_bytes_s=1000.0, queue_bytes_max=1000))
    arrivals = [radio.transmit("r1", "r2", "log", 500, 0.0) for _ in range(5)]
    assert arrivals == [[0.5], [1.0], [1.5], [], []]
    assert radio.dropped == {"queue": 2}


def test_bulk_waits_for_control_and_control_never_for_bulk() -> None:
    radio = radio_of(LinkParameters(bandwidth_bytes_s=1000.0))
    assert radio.transmit("r1", "r2", "latent", 5000, 0.0) == [5.0]
    assert radio.transmit("r1", "r2", "hb", 100, 0.0) == [0.1]
    assert radio.transmit("r1", "r2", "latent", 1000, 0.0) == [6.1]


def test_links_are_directed() -> None:
    override = LinkOverride("r1", "*", LinkParameters(loss_ratio=1.0))
    radio = radio_of(overrides=(override,))
    assert radio.transmit("r1", "r2", "hb", 10, 0.0) == []
    assert radio.transmit("r2", "r1", "hb", 10, 0.0) == [0.0]


def test_range_is_decided_by_true_positions_and_unknown_ones_are_in_range() -> None:
    radio = radio_of(range_m=10.0)
    assert radio.transmit("r1", "r2", "hb", 10, 0.0) == [0.0]
    radio.update_position("r1", [0.0, 0.0, 0.0])
    radio.update_position("r2", np.array([6.0, 8.0, 0.0]))
    assert radio.transmit("r1", "r2", "hb", 10, 0.0) == [0.0]
    assert radio.transmit("r1", "r2", "hb", 10, 0.0, sender_position_m=(0.0, 0.0, 1.0)) == []
    assert radio.dropped == {"range": 1}


def test_a_partition_separates_its_groups_for_its_time_only() -> None:
    partition = Partition((("r1", "r2"), ("r3",)), from_s=1.0, to_s=2.0)
    heard = {
        (a, b): partition.separates(a, b, 1.0) for a, b in (("r1", "r2"), ("r1", "r3"), ("r1", "r4"), ("r4", "r5"))
    }
    assert heard == {("r1", "r2"): False, ("r1", "r3"): True, ("r1", "r4"): True, ("r4", "r5"): False}
    radio = radio_of(partitions=(partition,))
    assert [len(radio.transmit("r1", "r3", "hb", 1, t)) for t in (0.9, 1.0, 1.9, 2.0)] == [1, 0, 0, 1]


def test_a_blackout_silences_both_directions() -> None:
    radio = radio_of(blackouts=(Blackout(("r2",), 0.0, 1.0),))
    assert [radio.transmit(*pair, "hb", 1, 0.0) for pair in (("r1", "r2"), ("r2", "r1"), ("r1", "r3"))] == [
        [],
        [],
        [0.0],
    ]


def test_new_parameters_hold_from_the_next_message_on() -> None:
    radio = radio_of()
    assert radio.transmit("r1", "r3", "hb", 1, 0.0)
    radio.parameters = radio.parameters.partitioned((("r1",),), 1.0)
    assert not radio.transmit("r1", "r3", "hb", 1, 1.0)
    radio.parameters = replace(radio.parameters.healed(), link=LinkParameters(loss_ratio=1.0))
    assert not radio.transmit("r1", "r3", "hb", 1, 2.0)
    assert radio.dropped == {"partition": 1, "loss": 1}


def test_a_seed_repeats_every_arrival() -> None:
    link = LinkParameters(0.1, 0.1, 5.0, 0.1, 0.1, 0.1, 0.1, 0.2, 10_000.0)
    first, second = (sent(radio_of(link), 2000) for _ in range(2))
    other = sent(Radio(RadioParameters(link), np.random.default_rng(SEED + 1)), 2000)
    assert first == second
    assert first != other


@pytest.mark.parametrize(
    "wrong",
    [
        {"loss_ratio": 1.5},
        {"duplicate_ratio": math.nan},
        {"latency_s": -1.0},
        {"bandwidth_bytes_s": 0.0},
        {"burst_messages_mean": 0.5},
    ],
)
def test_refuses_parameters_that_mean_nothing(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LinkParameters(**wrong)  # type: ignore[arg-type]
