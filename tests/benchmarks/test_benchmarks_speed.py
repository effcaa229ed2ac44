"""The speed of the simulator: turns of cases, the rows they give, and what the systems count."""

import pytest

import ganlane
from benchmarks.speed import __main__ as speed
from benchmarks.speed import systems
from benchmarks.speed.measure import Labels, Sample, make_row
from benchmarks.speed.sumo import EGO, ROOM_M, OnRamp, start_on_ramp
from benchmarks.speed.systems import Road
from ganlane import keys
from ganlane.agents import RainbowConfig

LABELS = Labels("mine", "idm", 9, 3, "eager", "cpu", 1, 4)
QUICK = ["--quick", "--seconds", "0.001", "--no-peers", "--modes", "eager"]


def test_a_row_holds_medians_over_the_turns():
    row = make_row(LABELS, [Sample(wall_s, 2 * wall_s, 40, 400) for wall_s in (1.0, 4.0, 2.0)])
    assert (row["physics_steps_per_s"], row["decisions_per_s"]) == (200, 20)
    assert row["physics_steps_per_cpu_s"] == 100
    assert row["spread"] == pytest.approx(1.5 / 2)
    assert (row["ratio"], row["system"]) == (None, "mine")


def test_a_ratio_compares_turns_of_the_same_round():
    # Both are ten times slower in the second round, when the machine was busy.
    mine = [Sample(wall_s, 1.0, 1, 300) for wall_s in (1.0, 10.0, 1.0)]
    peer = [Sample(wall_s, 0.5, 1, 10) for wall_s in (1.0, 10.0, 1.0)]
    row = make_row(LABELS, mine, peer)
    assert (row["ratio"], row["ratio_cpu"]) == pytest.approx((30, 15))


@pytest.mark.parametrize("mode", ["eager", "native"])
def test_bare_physics_moves_every_environment_for_the_whole_decision(mode):
    assert systems.start_physics(Road(), mode, "cpu", 5)(3) == 5 * 3 * 10


@pytest.mark.parametrize("start", [systems.start_environment, systems.start_gymnasium])
@pytest.mark.parametrize("batch", [1, 8])
def test_only_simulated_steps_count(start, batch):
    run = start(Road(), "native", "cpu", batch)
    decisions = 50
    # Whoever leaves the road, which a third of the random actions may do, is out at once.
    assert 0.4 * 10 * batch * decisions < run(decisions) < 10 * batch * decisions


def test_scenes_are_driven_beside_a_highway_with_as_many_vehicles_and_lanes(capsys):
    assert speed.main([*QUICK, "--suite", "scenarios", "--batches", "2"]) == 0
    told = capsys.readouterr().out
    assert "21 vehicles on 3 lanes, 24 vehicles on 4 lanes, 20 vehicles on 3 lanes" in told
    highway = "ganlane highway with as many vehicles, random actions"
    for name in ("ganlane merge, random actions", "ganlane exit, keeping its lane", highway):
        assert name in told


def test_a_training_fills_its_buffer_and_learns_as_often_as_it_should(monkeypatch):
    small = {"hidden": (16, 16), "batch_size": 32, "capacity": 512, "warmup": 64}
    config = RainbowConfig(**small, decisions_per_update=8)
    states = []
    make_state = systems.TrainingState

    def noted(*parts):
        states.append(make_state(*parts))
        return states[0]

    monkeypatch.setattr(systems, "TrainingState", noted)
    run = systems.start_training(Road(), "eager", "cpu", 16, config, 300)
    (state,) = states
    agent, decisions, updates = state.agent, state.decisions, state.agent.updates
    assert len(agent.replay) == 300
    assert len(agent.replay.sampler.priorities.view(-1)[:300].unique()) > 250
    assert 0 < run(3) <= 3 * 16 * 10
    assert (state.decisions - decisions, agent.updates - updates) == (3 * 16, 3 * 16 // 8)


def test_peers_drive_our_road_and_the_baseline_has_our_network():
    pytest.importorskip("highway_env", reason="highway-env comes with the extra 'bench'")
    pytest.importorskip("stable_baselines3", reason="it comes with the extra 'bench'")
    env = systems.make_highway(Road(vehicles=4, lanes=2))
    assert (len(env.road.vehicles), len(env.road.network.lanes_list())) == (4, 2)
    assert systems.start_highway(Road())(2) == 20
    exits = systems.make_highway(Road(scene="exit"))
    assert type(exits).__name__ == "ExitEnv"
    config = RainbowConfig(hidden=(12, 8), batch_size=8, decisions_per_update=8)
    assert systems.start_baseline(Road(vehicles=4), config)(2) == 2 * 8 * 10


@pytest.fixture
def sumo():
    """A process has one: it is closed for the tests that follow."""
    libsumo = pytest.importorskip("libsumo", reason="libsumo comes with the extra 'bench'")
    yield
    libsumo.close()


@pytest.mark.usefixtures("sumo")
def test_sumo_drives_our_on_ramp_until_its_ego_is_at_the_goal():
    ramp = OnRamp()
    vehicle = ramp.sumo.vehicle
    state = ganlane.make_env(env="on_ramp", seed=0).reset()[keys.VEHICLES]
    fronts_m = (state["x"] + 0.5 * state["length"])[0].tolist()
    assert len(vehicle.getIDList()) == len(fronts_m) == 20
    for slot, front_m in enumerate(fronts_m):
        is_beside = vehicle.getRoadID(str(slot)) == "beside"
        begin_m = 150.0 if is_beside else -ROOM_M
        assert vehicle.getLanePosition(str(slot)) == pytest.approx(front_m - begin_m, abs=0.01)
    seconds = 0
    while vehicle.getDistance(EGO) > 1.0 or seconds == 0:
        ramp.step(keys.KEEP)
        seconds += 1
    # At the goal it starts anew; on the way the ramp's vehicles have merged.
    assert 1000 / 23 < seconds < ramp.episode.timeout_s
    assert start_on_ramp()(3) == 30


def test_the_table_goes_into_the_document(tmp_path):
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- begin bench sim -->\n<!-- end bench sim -->\nafter\n")
    assert speed.main([*QUICK, "--batches", "2", "--report", str(document)]) == 0
    text = document.read_text()
    assert "python -m benchmarks.speed --quick" in text
    for system in ("physics", "environment"):
        assert f"| ganlane {system} | idm_mobil | eager | cpu | 1 | 2 |" in text


def test_every_traffic_is_measured_and_left_out_where_there_is_no_kernel(capsys, monkeypatch):
    line = ["--suite", "traffic", "--batches", "2", "--traffics", "idm", "gan"]
    assert speed.main([*QUICK, *line, "native"]) == 2  # a traffic of that name
    assert "native" in capsys.readouterr().err
    monkeypatch.setattr("ganlane.env.highway.why_not", lambda: "is not there")
    assert speed.main([*QUICK, "native", *line]) == 0
    told = capsys.readouterr()
    assert told.err.count("left out, native") == 2
    assert told.out.count("ganlane traffic") == 2
