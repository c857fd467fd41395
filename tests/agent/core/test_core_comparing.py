"""Whom a robot asks what changed: only those whose hashes differ, only for what changed, and not too often."""

from flocc_agent.core.comparing import AGAIN_S, ANSWER_PERIOD_S, PAUSE_MAX_S, PERIOD_PER_ENTRY_S, PERIOD_S, Comparisons
from flocc_agent.core.effects import Effect, Unicast
from flocc_protocol.ids import LogId
from flocc_protocol.messages import LOGS_MAX, DigestRequest, Digests, Heartbeat, LogDigest, TableState

OWN = TableState(1, 10)
LEVEL = TableState(1, 4)
DIGEST = LogDigest(LogId("r1"), 1, 1)


def heartbeat(digests: TableState = LEVEL, versions: TableState = LEVEL, boot: int = 7) -> Heartbeat:
    return Heartbeat(1, boot, 0, None, 0, 0, digests=digests, versions=versions)


def asked(effects: list[Effect]) -> list[tuple[str, int, int]]:
    found = [(e.to, e.message) for e in effects if isinstance(e, Unicast)]
    return [(to, m.digests_since, m.versions_since) for to, m in found if isinstance(m, DigestRequest)]


def hear(machine: Comparisons, said: Heartbeat, now: float, peer: str = "r2") -> list[tuple[str, int, int]]:
    return asked(machine.on_heartbeat(peer, said, OWN, OWN, now))


def told(through: int, entries: int = 1, boot: int = 7) -> Digests:
    return Digests(boot, through, (DIGEST,) * entries, 4, ())


def test_equal_hashes_ask_for_nothing() -> None:
    assert hear(Comparisons(64), heartbeat(), 0.0) == []


def test_a_new_neighbour_that_holds_something_else_costs_one_exchange() -> None:
    machine = Comparisons(64)
    assert hear(machine, heartbeat(TableState(2, 4)), 0.0) == [("r2", 0, 4)]
    machine.on_digests("r2", told(4), helped=True, now=0.1)
    assert [hear(machine, heartbeat(TableState(2, 4)), k / 2) for k in range(1, 20)] == [[]] * 19


def test_after_equal_hashes_only_what_changed_since_is_asked_for() -> None:
    machine = Comparisons(64)
    hear(machine, heartbeat(), 0.0)
    assert hear(machine, heartbeat(TableState(2, 6)), 1.0) == [("r2", 4, 4)]


def test_a_lost_answer_is_asked_for_again() -> None:
    machine = Comparisons(64)
    assert hear(machine, heartbeat(TableState(2, 4)), 0.0)
    assert hear(machine, heartbeat(TableState(2, 4)), PERIOD_S / 2) == []
    assert hear(machine, heartbeat(TableState(2, 4)), PERIOD_S)


def test_answers_pay_for_the_next_question_but_a_newcomer_is_asked_at_once() -> None:
    machine = Comparisons(64)
    hear(machine, heartbeat(TableState(2, 4)), 0.0)
    hear(machine, heartbeat(), 0.0, "r3")
    machine.on_digests("r2", told(4, entries=50), helped=True, now=0.0)
    assert hear(machine, heartbeat(TableState(3, 5)), 50 * PERIOD_PER_ENTRY_S - 0.01, "r3") == []
    assert hear(machine, heartbeat(TableState(3, 5)), 0.5, "r4") == [("r4", 0, 4)]
    assert hear(machine, heartbeat(TableState(3, 5)), 50 * PERIOD_PER_ENTRY_S, "r3") == [("r3", 4, 4)]


def test_a_table_in_parts_is_asked_for_without_that_pause() -> None:
    machine = Comparisons(64)
    hear(machine, heartbeat(TableState(2, 600)), 0.0)
    machine.on_digests("r2", told(256, entries=LOGS_MAX), helped=True, now=0.1)
    assert hear(machine, heartbeat(TableState(2, 600)), PERIOD_S) == [("r2", 256, 4)]


def test_one_whose_changes_are_no_news_is_asked_ever_more_rarely() -> None:
    machine, questions_s, now = Comparisons(64), [], 0.0
    while now < 60.0:
        if hear(machine, heartbeat(TableState(2, 4 + int(10 * now))), now):
            questions_s.append(now)
            machine.on_digests("r2", told(4 + int(10 * now)), helped=False, now=now)
        now += 0.1
    assert len(questions_s) < 60.0 / PAUSE_MAX_S + 5
    machine.on_digests("r2", told(4), helped=True, now=now)
    assert hear(machine, heartbeat(TableState(2, 900)), now + PERIOD_S)


def test_where_hashes_differ_for_good_everything_is_asked_for_again_rarely() -> None:
    machine, questions = Comparisons(64), 0
    for second in range(200):
        questions += len(hear(machine, heartbeat(TableState(2, 4)), float(second)))
        machine.on_digests("r2", told(4), helped=False, now=float(second))
    assert questions == 1 + 200 // AGAIN_S


def test_a_restart_begins_anew() -> None:
    machine = Comparisons(64)
    hear(machine, heartbeat(), 0.0)
    assert hear(machine, heartbeat(TableState(2, 2), boot=8), 1.0) == [("r2", 0, 4)]
    machine.on_digests("r2", told(400, boot=7), helped=True, now=1.0)
    assert hear(machine, heartbeat(TableState(2, 2), boot=8), 1.5) == [("r2", 0, 4)]


def test_one_that_asks_again_and_again_is_answered_at_a_bounded_rate() -> None:
    machine = Comparisons(64)
    answers = sum(machine.may_answer("r9", k * 0.001) for k in range(10_000))
    assert answers <= 10.0 / ANSWER_PERIOD_S + 1
    assert machine.may_answer("r2", 10.0)


def test_strangers_do_not_fill_the_memory() -> None:
    machine = Comparisons(64)
    for k in range(3000):
        hear(machine, heartbeat(TableState(2, 1)), float(k), f"r{k}")
        machine.may_answer(f"r{k}", float(k))
    assert all(size <= size_max for size, size_max in machine.sizes().values())
