"""`flocc bench solver --keyframes N --closures M`: a round that adds ten closures ends where a whole solve ends."""

import json

from typer.testing import CliRunner

from flocc_lab.commands.bench import bench


def test_a_round_ends_where_a_whole_solve_ends() -> None:
    answer = CliRunner().invoke(bench, ["solver", "--keyframes", "600", "--closures", "60", "--json"])
    assert answer.exit_code == 0, answer.output
    result = json.loads(answer.output)
    assert (result["keyframes"], result["closures"]) == (600, 60)
    assert result["apart_m"] < 0.01
    assert result["apart_deg"] < 0.1
    assert result["ratio"] > 0.0
    assert 0 < result["round"]["solves"] < result["full"]["solves"], "what is old is not solved anew"


def test_the_result_is_told_in_lines() -> None:
    asked = ["--formulation", "base", "--method", "lm"]
    answer = CliRunner().invoke(bench, ["solver", "--keyframes", "400", "--closures", "30", *asked])
    assert answer.exit_code == 0, answer.output
    assert "400 keyframes, 30 closures, base, lm" in answer.output
    assert "ten closures more" in answer.output
