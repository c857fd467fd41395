"""Both error rates of what a robot believes of a leader, on a few members of the drawn family."""

from flocc_lab.correction_family import judged


def test_honest_corrections_are_believed_and_lies_are_held() -> None:
    table = judged(6, first=41, slow=1)
    assert sum(bad for _, bad in table.honest.values()) <= 1
    told, held = (sum(each[k] for each in table.lies.values()) for k in (0, 1))
    assert held >= 0.85 * told > 100
    told, held = (sum(each[k] for each in table.slow.values()) for k in (0, 1))
    assert held >= 0.7 * told > 10
