"""``env.kernel=native``: the same environment, driven by the native kernel."""

import copy
import pickle

import pytest
import torch
from entry_own_parts import Cruise
from reference.refusals import user_error
from reference.worlds import environment, few_changes, random_actions
from torchrl.envs import Transform

import ganlane
from ganlane import keys
from ganlane.env.highway import say_once
from ganlane.native.library import ROWS_PER_THREAD, threads_allowed
from ganlane.native.settings import NATIVE_FORMS
from ganlane.runtime import kernel_threads
from ganlane.settings.actions import ActionParameters
from ganlane.settings.driving import IdmParameters
from ganlane.settings.road import EXIT, FlowParameters, LaneStretch
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.transforms import ActionMaskTransform, ObservationTransform

pytestmark = pytest.mark.kernel


def native(num_envs: int = 8, **others):
    options = {"dtype": torch.float32, "kernel": "native", **others}
    return environment(num_envs=num_envs, **options)


def test_its_keys_specs_and_first_states_are_those_of_the_tensor_code():
    ours = native()
    theirs = native(kernel="torch")
    for name in ("observation_spec", "action_spec", "reward_spec", "done_spec", "state_spec"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert (ours.reset() == theirs.reset()).all()
    after = [set(env.rand_step(env.reset())["next"].keys(True, True)) for env in (ours, theirs)]
    assert after[0] == after[1]


class Threads(Transform):
    """Looks how many threads torch and the kernel have during a step."""

    def __init__(self):
        super().__init__()
        self.seen = set()

    def _call(self, next_tensordict):
        self.seen.add((torch.get_num_threads(), threads_allowed()))
        return next_tensordict


@pytest.mark.parametrize("threads", [1, 2])
def test_two_threads_are_the_kernels_alone(threads):
    """Around the kernel torch computes on one thread, and has both again afterwards."""
    before = torch.get_num_threads()
    # A command that ran in this process may have set the kernel's.
    token = kernel_threads.set(None)
    try:
        torch.set_num_threads(threads)
        env = ganlane.make_env(traffic="idm_mobil", num_envs=2 * ROWS_PER_THREAD)
        looking = Threads()
        env.append_transform(looking)
        env.rand_step(env.reset())
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
        kernel_threads.reset(token)
    assert (1, threads) in looking.seen


@pytest.mark.parametrize("wrong", [torch.tensor([7.0, 8.0]), torch.tensor([[7], [8]])])
def test_episodes_that_are_no_whole_numbers_in_a_row_are_refused(wrong):
    env = native(2)
    state = env.reset().set("_reset", torch.tensor([[True], [False]]))
    with user_error(r"next_episode is \[.*; give next_episode as int64 of shape \[2\]"):
        env.reset(state, next_episode=wrong)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"traffic": Cruise(Road(), 0)}, "does not drive Cruise"),
        ({"dtype": torch.float64}, "in float32"),
        ({"ring_m": 500.0}, "has no ring"),
        (
            {"traffic": IdmMobilTraffic(Road(), idm=IdmParameters(headway_s=1.0))},
            "one set of parameters",
        ),
        ({"kernel": "fast"}, "expected one of torch, native, auto"),
    ],
)
def test_what_the_kernel_cannot_do_it_refuses_in_one_sentence(settings, sentence):
    with user_error(sentence):
        native(**settings)


def test_auto_takes_the_tensor_code_where_the_kernel_cannot_and_says_once_when_it_can(capsys):
    say_once.cache_clear()
    assert environment(kernel="auto").kernel is None
    two = [native(kernel="auto") for _ in range(2)]
    assert all(env.kernel is not None for env in two)
    assert capsys.readouterr().err == ""
    for env in two:
        env.rand_step(env.reset())
    said = capsys.readouterr().err.splitlines()
    assert said == ["env.kernel=auto: the native kernel"]


#: A lane that leaves the road, into which vehicles enter.
FLOW = {
    "lanes": 2,
    "stretches": (LaneStretch(50.0, 200.0, EXIT), LaneStretch()),
    "flow": FlowParameters(vph=3600.0, to_m=300.0),
}


@pytest.mark.parametrize(
    "options",
    [{"kernel": "torch"}, {"abort": True}, FLOW, {"actions": ActionParameters("continuous")}],
    ids=["torch", "abort", "flow", "continuous"],
)
def test_a_recorder_sees_every_physics_step_and_ends_where_the_decision_does(options):
    """With ends and commands off the road in the middle, and without a bit of difference, but for
    pedals and wheel, of which the tensor code shows the steps.
    """
    config = {"goal_m": 140.0, "timeout_s": 9.5, "seed": 3, **options}
    env = native(32, **config)
    plain = native(32, **config)
    generator = torch.Generator().manual_seed(0)
    steps = []
    env.recorder = lambda vehicles, running: steps.append((vehicles, running))
    state = env.reset()
    for _ in range(12):
        steps.clear()
        state["action"] = random_actions(env, generator)
        stepped, following = env.step_and_maybe_reset(state)
        after = stepped["next"]
        assert (plain.step(state.clone())["next"] == after).all()
        taken = sum(running.long() for _, running in steps)
        assert torch.equal(taken, after[keys.STEP] - state[keys.STEP])
        shown = steps[-1][0]
        # Who enters after the last step stands where the section begins.
        stays = (taken > 0)[:, None] & (after[keys.VEHICLES, "x"] != FLOW["flow"].from_m)
        atol = 2e-3 if env.actions.form == "continuous" else 0.0
        for name in ("x", "y", "heading", "speed", "acceleration"):
            expected = after[keys.VEHICLES, name][stays]
            torch.testing.assert_close(getattr(shown, name)[stays], expected, atol=atol, rtol=0.0)
        state = following


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_an_environment_can_be_copied_and_sent_to_another_process(copied):
    env = ganlane.make_env("idm_mobil", 4, kernel="native", observation="lane_view")
    td = env.rand_action(env.reset())
    assert (copied(env).step(td.clone())["next"] == env.step(td)["next"]).all()


NOISY = {"position_noise_m": 2.0, "dropout": 0.2}


@pytest.mark.parametrize("form", sorted(NATIVE_FORMS))
@pytest.mark.parametrize(
    ("abort", "sensors", "mask"),
    [(False, NOISY, "safe"), (True, None, "safe"), (False, None, "foresight")],
)
def test_the_lane_view_and_the_safe_actions_are_those_of_the_tensor_code(
    form, abort, sensors, mask
):
    """The view up to the rounding of the exponential function.

    With lorries, and with what the sensors deliver.
    """
    env = ganlane.make_env(
        "idm_mobil",
        64,
        observation={"name": form, "sensors": sensors},
        mask=mask,
        kernel="native",
        vehicles=20,
        spread_m=200.0,
        truck_share=0.3,
        ego={"abort_lane_change": abort},
    )
    plain_view = ObservationTransform(Road(), 20, form)
    plain_mask = ActionMaskTransform(Road(), mask, abort=abort)
    refused = 0
    hopeless = 0
    td = env.reset()
    for _ in range(20):
        expected = plain_mask(plain_view(td.clone()))
        assert torch.allclose(td[keys.OBSERVATION], expected[keys.OBSERVATION], atol=1e-6)
        for name in (keys.ACTION_MASK, keys.NO_SAFE_ACTION):
            assert torch.equal(td[name], expected[name])
        refused += int((~td[keys.ACTION_MASK]).sum())
        hopeless += int(td[keys.NO_SAFE_ACTION].sum())
        td = env.step_and_maybe_reset(td.set("action", few_changes(td)))[1]
    assert refused > 500
    assert hopeless > 0
