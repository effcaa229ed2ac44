"""One step of each preset in closed loop, and joint rollouts of recorded scenes."""

import math
from dataclasses import replace

import pytest
import torch
from reference.small_networks import silenced, small_generator
from reference.worlds import vehicles

from ganlane.generator import closed_loop
from ganlane.generator.windows import cut_segments
from ganlane.settings.generator import EXTRA_INPUTS, CalibratedConfig
from ganlane.sim.idm import idm_acceleration
from ganlane.sim.state import Road

ROAD = Road(3, 4.0)


def steady_generator(along=0.0, aside=0.0):
    """A network whose residual is always the same."""
    generator = silenced(small_generator(EXTRA_INPUTS)).double().requires_grad_(False)
    generator.head.bias.copy_(torch.tensor([along, aside]))
    return generator


def drive(generator, state, seconds):
    """Typical drivers, whose headway is 1.27 s."""
    history = closed_loop.start(generator, closed_loop.displacement_of(state))
    zero = torch.zeros_like(history.displacement)
    memory = closed_loop.DriverMemory(history, zero, torch.full_like(state.x, 1.27))
    z = torch.zeros(*state.x.shape, generator.sizes.noise, dtype=state.x.dtype)
    for _ in range(round(seconds / 0.1)):
        state, memory = closed_loop.anchored_step(generator, state, ROAD, memory, z)
    return state, memory


def test_without_a_residual_a_lane_change_arrives_and_does_not_overshoot():
    state = vehicles({"target_lane": 1})
    generator = steady_generator()
    course = []
    for _ in range(20):
        state, _ = drive(generator, state, 0.5)
        course.append(state.y.item())
    assert course[-1] == pytest.approx(4.0, abs=0.3)
    assert max(course) < 4.05


def test_the_first_step_is_idm_and_the_lateral_law():
    state = vehicles({"y": 0.5}, {"x": 30.0})
    after, _ = drive(steady_generator(), state, 0.1)
    gap, speed = torch.tensor([30.0 - 4.5, 20.0], dtype=torch.float64)
    idm = replace(closed_loop.ANCHOR.idm, headway_s=1.27)
    expected = idm_acceleration(speed, 25.0, gap, speed, idm)
    assert after.x[0, 0].item() == pytest.approx(2.0 + 0.01 * expected.item(), abs=1e-9)
    assert after.y[0, 0].item() == pytest.approx(0.5 + 0.01 * 0.3 * -0.5, abs=1e-9)


def test_a_network_that_always_pushes_changes_the_speed_for_a_while_only():
    state, memory = drive(steady_generator(along=3.0), vehicles({"desired_speed": 20.0}), 32)
    assert state.speed.item() == pytest.approx(20.0, abs=0.3)
    assert memory.mean[0, 0, 0].item() == pytest.approx(4 * math.tanh(0.75), abs=1e-4)


def test_a_network_that_always_pushes_sideways_does_not_push_the_body_out_of_its_lane():
    state, _ = drive(steady_generator(aside=5.0), vehicles({}), 3)
    room = 0.5 * (4.0 - 2.5) - 0.1
    assert 0.2 < state.y.item() < room + 0.05


def test_the_latent_vector_stays_standard_normal_and_forgets_in_its_period():
    torch.manual_seed(0)
    begin = z = torch.randn(20000)
    for _ in range(50):
        z = closed_loop.wander(z, torch.randn(20000), period_s=5.0)
    assert z.std().item() == pytest.approx(1.0, abs=0.02)
    assert (z * begin).mean().item() == pytest.approx(math.exp(-1), abs=0.02)
    fresh = torch.randn(5)
    torch.testing.assert_close(closed_loop.wander(z[:5], fresh, 0.0), fresh)


def test_the_paper_drives_the_first_predicted_displacement():
    generator = small_generator().double().requires_grad_(False)
    state = vehicles({}, {"x": 25.0, "lane": 1})
    history = closed_loop.start(generator, closed_loop.displacement_of(state))
    noise = torch.randn(1, 2, 4).double()
    past = closed_loop.displacement_of(state)[..., None, :].expand(1, 2, 8, 2)
    predicted = generator(
        generator.observe(past, torch.stack([state.x, state.y], -1), state.valid), noise
    )
    after, _ = closed_loop.paper_step(generator, state, history, noise)
    moved = torch.stack([after.x - state.x, after.y - state.y], -1)
    torch.testing.assert_close(moved, predicted[..., 0, :])


@pytest.fixture
def generator():
    return small_generator(EXTRA_INPUTS)


def typical_rollout(generator, segments):
    """Positions when every driver is typical and z = 0."""
    drivers = closed_loop.driver_params(segments)
    noise = torch.zeros(1 + segments.future.shape[1], 1, *segments.length.shape, 4)
    return closed_loop.rollout(generator, segments, drivers, noise, CalibratedConfig())[0]


def test_vehicles_that_come_later_start_when_they_appear_and_are_not_scored(scenes, generator):
    segments = cut_segments([(scenes[0], 0)], horizon=9)
    segments.present[:, :12, 2] = False
    positions = typical_rollout(generator, segments)
    torch.testing.assert_close(positions[:, :4, 2], segments.future[:, :4, 2])
    assert not torch.allclose(positions[:, 4:, 2], segments.future[:, 4:, 2], atol=1e-5)
    assert not segments.scored[0, :, 2].any()
    # Where it goes later does not matter.
    segments.positions[:, 14:, 2] += 5.0
    torch.testing.assert_close(typical_rollout(generator, segments), positions)


def test_gradient_of_a_rollout_is_finite_and_reaches_every_parameter(scenes, generator):
    segments = cut_segments([(scenes[0], 0), (scenes[1], 9)], horizon=6)
    noise = torch.randn(7, 3, 2, 7, 4)
    positions = closed_loop.rollout(
        generator, segments, closed_loop.driver_params(segments), noise, CalibratedConfig()
    )
    (positions - segments.future).abs()[:, segments.scored].sum().backward()
    for name, parameter in generator.named_parameters():
        assert 0 < parameter.grad.abs().sum() < math.inf, name


def test_nothing_of_the_future_enters_an_evaluation(scenes, generator):
    segments = cut_segments([(scenes[0], 0)], horizon=5)
    before = typical_rollout(generator, segments.without_intentions())
    segments.positions[:, 9:] += 7.0
    segments.target_lane[:, 9:] = 0
    torch.testing.assert_close(typical_rollout(generator, segments.without_intentions()), before)
