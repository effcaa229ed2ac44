"""The action mask: what is allowed, for whom, and that policies, replay and losses respect it."""

import pytest
import torch
from reference import scalar
from reference.refusals import user_error
from reference.worlds import environment, random_scenes, vehicles
from tensordict import TensorDict
from torchrl.envs import ActionMask, Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

import ganlane
from ganlane import keys
from ganlane.agents.drivers import ExploringPolicy, GreedyPolicy, MaskedPolicy, RandomDriver
from ganlane.build import make_driver
from ganlane.settings.commands import DrivingConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters
from ganlane.sim.state import Road, Vehicles
from ganlane.transforms import ActionMaskTransform

KEEP_ONLY = [True, False, False]
ALL = [True, True, True]


def allowed(*cars, form="safe", direction=0, abort=False, limit=4.0):
    """The mask of the first of ``cars``, and whether no action is safe."""
    transform = ActionMaskTransform(Road(), form, limit, abort=abort)
    mask, none = transform.allowed(vehicles(*cars), torch.tensor([direction]), Road())
    return mask[0].tolist(), bool(none[0])


# --- what is allowed

ALONE = ({"x": 0.0, "lane": 1}, {"x": 500.0, "lane": 0})
LEFT_ONLY = [True, True, False]
RIGHT_ONLY = [True, False, True]
BESIDE = [{"x": 0.0, "lane": 1}, {"x": 1.0, "lane": 2}, {"x": -1.0, "lane": 0}]


@pytest.mark.parametrize(("lane", "expected"), [(0, LEFT_ONLY), (1, ALL), (2, RIGHT_ONLY)])
def test_commands_off_the_road_are_never_allowed(lane, expected):
    assert allowed({"x": 0.0, "lane": lane}, {"x": 500.0, "lane": 0}, form="legal")[0] == expected


def test_every_row_has_the_lanes_of_its_own_road():
    road = Road(lanes=torch.tensor([[2], [3]]), lane_width_m=torch.tensor([[4.0], [4.0]]))
    middle = vehicles({"x": 0.0, "lane": 1})
    both = middle.part([0, 0])
    mask, _ = ActionMaskTransform(road, "legal").allowed(both, torch.zeros(2).long(), road)
    assert mask.tolist() == [RIGHT_ONLY, ALL]


@pytest.mark.parametrize("form", ["legal", "safe"])
def test_during_a_lane_change_nothing_but_keeping_is_allowed(form):
    assert allowed(*ALONE, form=form, direction=1)[0] == KEEP_ONLY


@pytest.mark.parametrize(("direction", "expected"), [(0, ALL), (1, RIGHT_ONLY), (-1, LEFT_ONLY)])
def test_who_may_turn_back_may_give_the_opposite_command_alone(direction, expected):
    assert allowed(*ALONE, form="legal", abort=True, direction=direction)[0] == expected


def test_turning_back_must_be_safe_too():
    """On its way from lane 0 to lane 1; somebody fast has come up in lane 0 meanwhile."""
    ego = {"x": 0.0, "y": 3.0, "target_lane": 1, "speed": 15.0}
    back = {"abort": True, "direction": 1}
    assert allowed(ego, {"x": -200.0, "lane": 0}, **back)[0] == RIGHT_ONLY
    assert allowed(ego, {"x": -15.0, "lane": 0, "speed": 30.0}, **back)[0] == KEEP_ONLY


@pytest.mark.parametrize(
    ("ego", "other", "with_it", "without"),
    [
        # Of the new follower, and of the ego behind its new leader; both are behind one at 15 m/s.
        ({"lane": 0, "speed": 15.0}, {"x": -60.0, "lane": 1, "speed": 24.0}, LEFT_ONLY, KEEP_ONLY),
        ({"lane": 1, "speed": 25.0}, {"x": 65.0, "lane": 2, "speed": 15.0}, ALL, RIGHT_ONLY),
    ],
)
def test_a_change_is_allowed_up_to_the_braking_that_it_asks_for(ego, other, with_it, without):
    """A limit a little above the deceleration allows, a little below forbids."""
    gap = abs(other["x"]) - 4.5
    braking = -scalar.idm(max(ego["speed"], other["speed"]), 25.0, gap, 15.0)
    assert 4.0 < braking < 20.0
    car = {"x": 0.0, **ego}
    assert allowed(car, other, limit=braking + 1e-6)[0] == with_it
    assert allowed(car, other, limit=braking - 1e-6)[0] == without


def test_nobody_changes_into_a_vehicle_alongside_but_where_it_is_not_there():
    assert allowed(*BESIDE)[0] == KEEP_ONLY
    assert allowed({"x": 0.0, "lane": 1}, {"x": 0.0, "lane": 2, "valid": False})[0] == ALL


def test_keeping_the_lane_is_allowed_when_nothing_is_safe_and_that_is_reported():
    """A standing car ahead, cars alongside.

    No change is possible, and braking harder than 4 m/s2 is all there is.
    """
    assert allowed(*BESIDE, {"x": 25.0, "lane": 1, "speed": 0.0}) == (KEEP_ONLY, True)
    assert allowed(*BESIDE, {"x": 500.0, "lane": 1}) == (KEEP_ONLY, False)


@pytest.fixture(scope="module")
def crowd():
    """4096 egos among eleven others each, in float32 as in the kernel."""
    fields = random_scenes(4096, 12, 3, seed=5)
    return Vehicles(*(field.float() if field.is_floating_point() else field for field in fields))


IDLE = torch.zeros(4096, dtype=torch.int64)


def test_foresight_forbids_what_safe_forbids_and_more(crowd):
    safe, foresight = (
        ActionMaskTransform(Road(), form).allowed(crowd, IDLE, Road())[0]
        for form in ("safe", "foresight")
    )
    assert not (foresight & ~safe).any()
    share = foresight[:, 1:].sum() / safe[:, 1:].sum()
    assert 0.5 < share < 0.98


# --- in the environment


def masked(form="safe", **options):
    base = environment(dtype=torch.float32, kernel="auto", **options)
    return TransformedEnv(base, Compose(ActionMaskTransform(base.road, form)))


def test_the_specs_hold_and_torchrls_own_action_mask_draws_from_it():
    env = masked(num_envs=4)
    check_env_specs(env)
    env.append_transform(ActionMask())
    state = env.reset()
    for _ in range(20):
        state = env.rand_action(state)
        assert bool(state[keys.ACTION_MASK].gather(1, state[keys.ACTION][:, None]).all())
        state = env.step_mdp(env.step(state))


def test_a_random_driver_behind_the_legal_mask_never_leaves_the_road():
    driver = RandomDriver(Road(), 2)
    for env, policy, leaves_it in (
        (masked("legal", num_envs=32, stream=2), MaskedPolicy(driver), False),
        (environment(num_envs=16, stream=2), driver, True),
    ):
        after = env.rollout(10, policy, break_when_any_done=False)["next"]
        assert bool(after["events", "out_of_road"].any()) == leaves_it


def test_the_mask_sees_what_the_ego_perceives_and_not_the_truth():
    """Sensors that never see anybody: every change looks safe."""
    blind = {"name": "lane_view_overlap", "sensors": {"dropout": 1.0}}
    unseeing, seeing, legal = (
        ganlane.make_env("idm_mobil", 64, spread_m=60, min_spacing_m=18, **options).reset()[
            "action_mask"
        ]
        for options in ({"mask": "safe", "observation": blind}, {"mask": "safe"}, {"mask": "legal"})
    )
    assert torch.equal(unseeing, legal)
    assert not torch.equal(seeing, legal)


# --- who obeys it


class Values(torch.nn.Module):
    """A 'network' that likes right best, then left."""

    def values(self, observation):
        return torch.tensor([[0.0, 1.0, 2.0]]).expand(observation.shape[0], 3)


@pytest.mark.parametrize(("mask", "chosen"), [(ALL, 2), (LEFT_ONLY, 1), (KEEP_ONLY, 0)])
def test_a_greedy_agent_takes_the_best_of_the_allowed_actions(mask, chosen):
    state = TensorDict({"observation": torch.zeros(1, 4), "action_mask": torch.tensor([mask])}, [1])
    assert GreedyPolicy(Values())(state)["action"].tolist() == [chosen]


def test_exploration_draws_allowed_actions_alone():
    policy = ExploringPolicy(Values(), torch.Generator().manual_seed(0), legal=lambda state: 1 / 0)
    policy.epsilon = 1.0
    mask = torch.tensor([LEFT_ONLY]).expand(300, 3)
    state = TensorDict({"observation": torch.zeros(300, 4), "action_mask": mask}, [300])
    assert set(policy(state)["action"].tolist()) == {0, 1}


def test_a_masked_driver_in_an_environment_without_a_mask_is_refused():
    with user_error("no action_mask"):
        MaskedPolicy(RandomDriver(Road(), 2))(environment().reset())


# --- names on the command line


def test_a_suffix_puts_any_driver_behind_a_mask_or_takes_it_away():
    driver = make_driver("mobil_egoistic+safe", EnvConfig())
    assert (driver.name, driver.mask) == ("mobil_egoistic+safe", MaskParameters("safe"))
    driven, policy = driver.driving(DrivingConfig())
    assert driven.mask.form == "safe"
    assert isinstance(policy, MaskedPolicy)
    unmasked = make_driver("mobil+none", EnvConfig())
    driven, _ = unmasked.driving(DrivingConfig(mask=MaskParameters("safe")))
    assert driven.mask.form == "none"


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: ActionMaskTransform(Road(), "soft"), "expected one of legal, safe, foresight"),
        (lambda: ActionMaskTransform(Road(), "safe", 0.0), "above 0"),
        (lambda: ganlane.make_env("idm", mask="save"), "did you mean"),
    ],
)
def test_mistakes_end_in_one_sentence(make, expected):
    with user_error(expected):
        make()
