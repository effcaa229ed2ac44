"""The update with its backward pass written out does what TorchRL's loss, autograd, clipping and Adam do."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict

from ganlane.agents.loss import UpdateGraph
from ganlane.agents.rainbow import Rainbow
from ganlane.parameters.agent import RainbowConfig
from ganlane.runtime import has_compiler

SIZE, STORED = 11, 600


def transitions(masked):
    draw = torch.Generator().manual_seed(1)

    def uniform(*shape):
        return torch.rand(*shape, generator=draw)

    following = {
        "observation": uniform(STORED, SIZE),
        "reward": 60.0 * uniform(STORED, 1) - 30.0,  # some targets lie outside the support
        "terminated": uniform(STORED, 1) < 0.1,
        "done": uniform(STORED, 1) < 0.1,
    }
    if masked:
        following["action_mask"] = uniform(STORED, 3) < 0.6
        following["action_mask"][:, 0] = True
    return TensorDict(
        {
            "observation": uniform(STORED, SIZE),
            "action": torch.randint(3, (STORED,), generator=draw),
            "steps_to_next_obs": torch.randint(1, 4, (STORED, 1), generator=draw),
            "next": TensorDict(following, [STORED]),
        },
        [STORED],
    )


def agent(graph=None, masked=False, **options):
    usual = {"hidden": (16, 24), "atoms": 7, "batch_size": 32, "warmup": 100, "capacity": 1000, "target_period": 3}
    config = RainbowConfig(**{**usual, "v_min": -20.0, "v_max": 20.0, **options})
    made = Rainbow(config, SIZE, seed=0)
    made.store(transitions(masked))
    if graph is not None:
        made.graph = UpdateGraph(made.network, made.loss, made.optimizer, config, compile=graph)
    return made


def assert_close(one, other):
    for (name, value), twin in zip(one.network.named_parameters(), other.network.parameters()):
        torch.testing.assert_close(value, twin, atol=2e-6, rtol=1e-5, msg=name)
    for mine, theirs in zip(one.optimizer.state.values(), other.optimizer.state.values()):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(mine[name], theirs[name], atol=1e-7, rtol=1e-3, msg=name)


def run_both(graph, masked=False, updates=8, **options):
    plain, graphed = agent(masked=masked, **options), agent(graph, masked, **options)
    for _ in range(updates):
        expected, found = plain.update(), graphed.update()
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value.detach(), atol=1e-5, rtol=1e-4, msg=name)
    assert_close(plain, graphed)
    assert plain.updates == graphed.updates == updates
    return plain, graphed


@pytest.mark.parametrize(
    ("masked", "options"),
    [
        (False, {}),
        (True, {"gradient_clip": 0.01}),
        (True, {"learning_rate_end": 1e-5, "learning_rate_decisions": 100, "hidden": (8,)}),
        (False, {"hidden": (8, 8, 8), "gamma": 0.9, "adam_eps": 1e-3}),
    ],
)
def test_updates_are_those_of_the_loss_of_autograd_and_of_adam(masked, options):
    run_both(False, masked, **options)


def test_training_can_change_from_one_way_to_the_other_and_be_resumed():
    plain, graphed = run_both(False)
    resumed = agent(False)
    resumed.load_state_dict(deepcopy(plain.state_dict()))
    for each in (plain, graphed, resumed):
        each.update()
    assert_close(plain, graphed)
    assert_close(plain, resumed)
    back = agent()
    back.load_state_dict(deepcopy(graphed.state_dict()))
    back.update(), plain.update()
    assert_close(plain, back)


@pytest.mark.parametrize("part", ["distributional", "double", "dueling", "noisy", "prioritised"])
def test_an_agent_without_one_of_the_components_keeps_the_other_way(part):
    config = RainbowConfig(**{part: False})
    assert Rainbow(config, SIZE, compile=True).graph is None


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_the_compiled_graph_does_the_same():
    run_both(True, masked=True)
