"""Claims: a peer is slowed down, and no crowd of names keeps a new one out for ever."""

from flocc_agent.runtime.inbox import SILENT_S, RateLimiter


def test_a_peer_above_its_rate_is_slowed_down_and_recovers() -> None:
    limiter = RateLimiter(messages_per_s=2.0, bytes_per_s=1000.0, peers_max=4)
    assert [limiter.refusal("r1", 10, 0.0) for _ in range(5)] == [None] * 4 + ["rate"]
    assert limiter.refusal("r2", 10, 0.0) is None
    assert limiter.refusal("r1", 10, 1.0) is None
    assert limiter.refusal("r1", 3000, 100.0) == "rate"


def test_a_crowd_of_names_that_fell_silent_gives_up_its_places() -> None:
    limiter = RateLimiter(100.0, 1e6, peers_max=256)
    for k in range(256):
        assert limiter.refusal(f"liar{k}", 10, 0.0) is None
    assert limiter.refusal("r2", 10, SILENT_S - 1.0) == "too-many-peers"
    for k in range(40):
        assert limiter.refusal(f"r{k}", 10, SILENT_S + k) is None
    assert limiter.refusal("liar0", 10, SILENT_S + 40.0) is None


def test_who_is_heard_keeps_its_place() -> None:
    limiter = RateLimiter(100.0, 1e6, peers_max=2)
    for name, now_s in (("r1", 0.0), ("r2", 1.0), ("r1", SILENT_S), ("r3", SILENT_S + 2.0), ("r4", SILENT_S + 3.0)):
        limiter.refusal(name, 10, now_s)
    assert [limiter.refusal(name, 10, SILENT_S + 4.0) for name in ("r1", "r3", "r2", "r4")] == [
        None,
        None,
        "too-many-peers",
        "too-many-peers",
    ]
