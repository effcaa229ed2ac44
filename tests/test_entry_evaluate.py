"""``ganlane evaluate`` from end to end, with tiny budgets, in process."""

from functools import partial

import pytest
from reference.refusals import last_path, results_in

from ganlane.config.run import run_command

main = partial(run_command, "evaluate")

SHORT = ["env.goal_m=40", "episodes=4"]
pytestmark = pytest.mark.usefixtures("empty_folder")


def run(capsys, *arguments):
    """The rows of the results."""
    assert main([*SHORT, *arguments]) == 0
    return results_in(last_path(capsys.readouterr().out).parent)["rows"]


def test_a_users_traffic_and_policy_stand_in_the_table(capsys):
    agents = "agents=[entry_own_parts.Stubborn,keep_lane]"
    rows = run(capsys, agents, "traffics=[entry_own_parts.Cruise]")
    assert [row["agent"] for row in rows] == ["entry_own_parts.Stubborn", "keep_lane"]
    assert rows[0]["mean_reward"] == rows[1]["mean_reward"]
    assert rows[0]["traffic"] == "entry_own_parts.Cruise"


def test_a_users_traffic_takes_parameters_of_its_own(capsys):
    target = "traffics=[{{name: entry_own_parts.Cruise, {}: 0.5}}]"
    run(capsys, "agents=[keep_lane]", target.format("share"))
    assert main(["agents=[keep_lane]", target.format("pace")]) == 2
    err = capsys.readouterr().err
    assert "pace" in err
    assert "it takes road, stream, share" in err
