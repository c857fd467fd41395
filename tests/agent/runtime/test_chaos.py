"""Claims on faults on demand: words become orders, orders change links, nonsense is one clear sentence."""

import pytest

from flocc_agent.radio import Blackout, LinkParameters, Partition, RadioParameters
from flocc_agent.runtime.chaos import BadOrder, Order, disturbed, read_order
from flocc_launch.swarm.chaos_orders import ChaosError, parse_order


@pytest.mark.parametrize(
    ("words", "order"),
    [
        ("partition r1,r2 | r3", Order(kind="partition", groups=(("r1", "r2"), ("r3",)))),
        ("partition r1 r2|r3", Order(kind="partition", groups=(("r1", "r2"), ("r3",)))),
        ("heal", Order(kind="heal")),
        ("kill r2", Order(kind="kill", robots=("r2",))),
        ("loss 0.3", Order(kind="loss", value=0.3)),
        ("range 20", Order(kind="range", value=20.0)),
        ("slow r1 10x", Order(kind="slow", robots=("r1",), value=10.0)),
        ("blackout r1,r2", Order(kind="blackout", robots=("r1", "r2"))),
    ],
)
def test_words_become_orders_and_travel(words: str, order: Order) -> None:
    assert parse_order(words) == order
    assert read_order(order.model_dump_json(exclude_defaults=True).encode()) == order


@pytest.mark.parametrize(
    "words",
    ["", "explode", "loss", "loss much", "loss 1.5", "loss -1", "kill", "partition", "heal now", "slow r1", "slow x"],
)
def test_nonsense_is_one_sentence_that_repeats_it(words: str) -> None:
    with pytest.raises(ChaosError) as error:
        parse_order(words)
    assert repr(words) in str(error.value)


@pytest.mark.parametrize("words", ["slow r1 1e9", "slow r1 0", "slow r1 1001x"])
def test_a_robot_is_slowed_down_within_bounds(words: str) -> None:
    with pytest.raises(ChaosError, match="'slow' takes a factor from 1 to 1000"):
        parse_order(words)


@pytest.mark.parametrize(
    "request_bytes",
    [b"", b"{}", b"\xff", b'{"kind": "rm"}', b'{"kind": "heal", "x": 1}', b'{"kind": "loss", "value": NaN}'],
)
def test_an_agent_refuses_what_is_no_order(request_bytes: bytes) -> None:
    with pytest.raises(BadOrder):
        read_order(request_bytes)


def test_orders_add_up_and_heal_takes_separations_back() -> None:
    links = RadioParameters()
    for words in ("loss 0.3", "latency 0.1", "range 20", "partition r1 | r2", "blackout r3"):
        links = disturbed(links, parse_order(words), now_s=5.0)
    lossy = LinkParameters(loss_ratio=0.3, latency_s=0.1)
    separated = {"partitions": (Partition((("r1",), ("r2",)), 5.0),), "blackouts": (Blackout(("r3",), 5.0),)}
    assert links == RadioParameters(lossy, range_m=20.0, **separated)  # type: ignore[arg-type]
    assert disturbed(links, parse_order("heal"), 9.0) == RadioParameters(lossy, range_m=20.0)
    assert disturbed(links, parse_order("calm"), 9.0) == RadioParameters()


def test_an_order_concerns_those_it_names_and_everybody_when_links_change() -> None:
    assert [parse_order(words).concerns("r2") for words in ("kill r1", "kill r2", "loss 0.1", "blackout r1")] == [
        False,
        True,
        True,
        True,
    ]
