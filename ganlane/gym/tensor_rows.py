"""Every traffic for gymnasium, by the TorchRL environment behind NumPy arrays; and its pictures."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import legal_actions
from ganlane.api import make_env
from ganlane.gym.rows import Flags, Floats, Rows, observation_space
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.native.batch import Stepped
from ganlane.options import Option, option
from ganlane.settings.observation import largest_number
from ganlane.sim.state import road_in
from ganlane.transforms import ObservationTransform
from ganlane.view import DrawingParameters, EpisodeLabel, FramePainter, Recorder
from ganlane.view.frames import Picture
from ganlane.view.record import outcome_of, road_of_row

#: Recorded physics steps that are kept: as many as the trails show.
_KEPT = round(DrawingParameters().trail_s / PHYSICS_STEP_S) + 1


class TensorRows(Rows):
    """N highways by the TorchRL environment, which :func:`ganlane.api.make_env` makes of the
    arguments.
    """

    env: TransformedEnv

    def __init__(self, traffic: Option, count: int, options: Mapping[str, Any]) -> None:
        self.env = env = make_env(traffic, count, **options)
        self.count, self.episode = count, env.base_env.episode
        form = next(
            (each.form for each in env.transform if isinstance(each, ObservationTransform)),
            "table3",
        )
        largest = largest_number(form, env.base_env.scenes.longest_m)
        self.space = observation_space(env.observation_spec[keys.OBSERVATION].shape[-1], largest)

    @torch.no_grad()
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        counters = {
            name: torch.as_tensor(
                np.broadcast_to(value, self.count).astype(np.int64), device=self.env.device
            )
            for name, value in ((keys.SEED, seed), (keys.EPISODE, episode))
        }
        self.state = self.env.reset(TensorDict(counters, [self.count], device=self.env.device))

    @torch.no_grad()
    def restart(self, rows: Flags) -> None:
        mask = torch.as_tensor(rows, device=self.env.device)[:, None]
        self.state = self.env.reset(self.now().set("_reset", mask))

    @torch.no_grad()
    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        stepped = self.env.step(
            self.now().set(keys.ACTION, torch.as_tensor(actions, device=self.env.device))
        )
        self.state, after = self.env.step_mdp(stepped), stepped.get("next")
        reward, *ended = (
            _array(after.get(name)[:, 0]) for name in ("reward", "terminated", "truncated")
        )
        return Stepped(self.observation(), reward.astype(np.float32), *ended)

    def now(self) -> TensorDictBase:
        """The state of all rows; raises :class:`UserError` before the first :meth:`start`."""
        # asked first, since check_started copies the numbers from the device
        if self.state is None:
            self.check_started()
        return self.state

    def observation(self) -> Floats:
        return np.clip(
            self.now().get(keys.OBSERVATION).cpu().numpy(), self.space.low, self.space.high
        )

    def mask(self) -> Flags:
        state = self.now()
        mask: Tensor | None = state.get(keys.ACTION_MASK, None)
        return _array(
            legal_actions(state, road_in(state, self.env.base_env.road)) if mask is None else mask
        )

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        state = self.state
        return (
            None
            if state is None
            else (_array(state.get(keys.SEED)), _array(state.get(keys.EPISODE)))
        )

    def info(self) -> dict[str, Any]:
        state = self.now()
        vehicles, ego, events = (
            state.get(keys.VEHICLES),
            state.get(keys.EGO),
            state.get(keys.EVENTS),
        )
        road = road_in(state, self.env.base_env.road)
        values = {
            "seed": state.get(keys.SEED),
            "episode_number": state.get(keys.EPISODE),
            "time_s": state.get(keys.STEP).double() * PHYSICS_STEP_S,
            "distance_m": ego.get("distance"),
            "speed_mps": vehicles.get("speed")[:, EGO_INDEX],
            "lane": road.lane_of(vehicles.get("y"))[:, EGO_INDEX].long(),
            "decisions": ego.get("decisions"),
            "lane_changes": ego.get("lane_changes"),
            **{
                name: events.get(name)[:, 0]
                for name in (*keys.END_EVENTS, keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)
            },
        }
        terms = {name: _array(term[:, 0]) for name, term in state.get(keys.REWARD_TERMS).items()}
        arrays = {name: _array(value) for name, value in values.items()}
        return {**arrays, "action_mask": self.mask().astype(np.int8), keys.REWARD_TERMS: terms}


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    return tensor.cpu().numpy()


# Gymnasium's render modes: frames of :mod:`ganlane.view`, drawn while episodes run


def _label(rows: Rows, row: int, traffic: str) -> EpisodeLabel:
    """The header's text for a row."""
    seed, episode = (int(rows.state.get(name)[row]) for name in (keys.SEED, keys.EPISODE))
    return EpisodeLabel(
        "ego", traffic, seed, episode, *road_of_row(rows.state, rows.env.base_env.road, row)
    )


class LiveView:
    """Records every physics step of one row.

    Args:
        rows: the row; the recorder of its environment is replaced.
        traffic: as the rows have it, for the header.
        window: shows every physics step in real time; None: pictures on request.
    """

    def __init__(self, rows: Rows, traffic: Option, window: Any = None) -> None:
        self.rows, self.traffic, self.window = rows, option("traffic", traffic).label(), window

    def start(self) -> None:
        """A new episode has begun."""
        self._recorder, self._outcome = Recorder(), ""
        #: Frames recorded before the present decision.
        self._before = 0
        self._label = _label(self.rows, 0, self.traffic)
        self._recorder.add(self.rows.state.get(keys.VEHICLES), 0.0)
        self.rows.env.base_env.recorder = self._recorder
        self._show()

    def before_step(self, action: int) -> None:
        """Record the action of the next step."""
        self._recorder.current_action = action
        del self._recorder.frames[:-_KEPT]
        self._before = len(self._recorder.frames)

    def after_step(self, reward: float) -> None:
        """Record the outcome of the step, and show its frames."""
        self._recorder.current_return += reward
        self._outcome = outcome_of(self.rows.state)
        self._show()

    def picture(self) -> Picture:
        """The last frame, [height, width, 3]."""
        return self._painter().draw(len(self._recorder.frames) - 1)

    def pictures(self) -> Iterator[Picture]:
        """The frames of the last decision, ten per second; after a reset, the only one."""
        return map(self._painter().draw, range(self._before, len(self._recorder.frames)))

    def close(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.close()

    def _painter(self) -> FramePainter:
        return FramePainter(self._recorder.trajectory(self._label, self._outcome))

    def _show(self) -> None:
        """Show the frames of the last decision in the window, in real time."""
        if self.window is None:
            return
        due = time.monotonic() + PHYSICS_STEP_S
        for picture in self.pictures():
            self.window.show(picture)
            self.window.wait(max(0.0, due - time.monotonic()))
            due = time.monotonic() + PHYSICS_STEP_S


class BatchView:
    """Draws the present state of every row, without trails; the header names the ``traffic``."""

    def __init__(self, rows: Rows, traffic: Option) -> None:
        self.rows, self.traffic = rows, option("traffic", traffic).label()
        self._returns, self._actions = np.zeros(rows.count), np.full(rows.count, -1)

    def start(self, fresh: Flags) -> None:
        """New episodes begin in the rows where ``fresh`` [N] is true."""
        self._returns[fresh], self._actions[fresh] = 0.0, -1

    def after_step(self, actions: npt.ArrayLike, reward: npt.NDArray[np.float64]) -> None:
        """Record actions and rewards [N] of a step."""
        self._returns += reward
        self._actions[:] = actions

    def pictures(self) -> tuple[Picture, ...]:
        """One of every row."""
        return tuple(map(self._picture, range(self.rows.count)))

    def _picture(self, row: int) -> Picture:
        recorder = Recorder(
            row, current_action=int(self._actions[row]), current_return=float(self._returns[row])
        )
        recorder.add(
            self.rows.state.get(keys.VEHICLES),
            float(self.rows.state.get(keys.STEP)[row]) * PHYSICS_STEP_S,
        )
        return FramePainter(recorder.trajectory(_label(self.rows, row, self.traffic))).draw(0)
