"""The observation as a TorchRL transform: Table III and the forms of it that were found to teach more."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from ganlane import keys
from ganlane.compiling import compiled
from ganlane.errors import UserError
from ganlane.sim.road import Road, road_in
from ganlane.sim.vehicles import Vehicles
from ganlane.transforms.lane_view import DRIFT_SIZE, LANE_VIEW_SIZE, lane_view, largest_nearness
from ganlane.transforms.sensors import perceived
from ganlane.transforms.table3 import (
    ObservationScale,
    as_list,
    distance_to_ego,
    nearest_first,
    other_vehicles,
    own_state,
)


class Form(NamedTuple):
    """What follows the own state: the list, nearest first; the lane view; own lane change.

    ``drift`` adds to the lane view where in their lanes the others are, ``overlap`` lets its gaps go below 0.
    """

    listed: bool = False
    viewed: bool = False
    progress: bool = False
    drift: bool = False
    overlap: bool = False


OBSERVATIONS: Final = {
    "table3": Form(listed=True),
    "table3_progress": Form(listed=True, progress=True),
    "lane_view": Form(viewed=True, progress=True),
    "table3_lane_view": Form(listed=True, viewed=True, progress=True),
    "lane_view_drift": Form(viewed=True, progress=True, drift=True),
    "lane_view_overlap": Form(viewed=True, progress=True, drift=True, overlap=True),
}


def observation_size(name: str, vehicles: int) -> int:
    """Length D of observation ``name`` for ``vehicles`` vehicles, the ego included."""
    form, others = OBSERVATIONS[name], vehicles - 1
    return 3 + 3 * form.listed * others + form.viewed * LANE_VIEW_SIZE + form.drift * DRIFT_SIZE + form.progress * 2


def largest_number(name: str, longest_m: float = 4.5) -> float:
    """What no number of observation ``name`` exceeds, but the first (speed over desired speed, without a bound).

    ``longest_m`` is the length of the longest vehicle, m (:attr:`ganlane.sim.scenes.Scenes.longest_m`): with
    ``lane_view_overlap`` the nearness counts metres of overlap.
    """
    return largest_nearness(longest_m) if OBSERVATIONS[name].overlap else 1.0


class ObservationTransform(Transform):
    """Write ``observation`` [N, D] from the raw state, the others as ``perceived`` has them where it is there.

    Args:
        road: the environment's.
        vehicles: M, the ego included.
        form: ``table3`` (the paper's literal 3 + 3 (M - 1) numbers), ``table3_progress`` (and the ego's own
            lane change: progress 0 to 1, direction -1, 0 or 1), ``lane_view`` (own state, lane view, lane
            change), ``lane_view_drift`` (and where in their lanes the others are), ``lane_view_overlap`` (and how far
            those beside the ego overlap it), ``table3_lane_view`` (list and lane view).
        scale: normalisers.

    Raises:
        UserError: an unknown form.
    """

    def __init__(
        self, road: Road, vehicles: int = 9, form: str = "table3_progress", scale: ObservationScale | None = None
    ) -> None:
        super().__init__(in_keys=[keys.VEHICLES, keys.EGO], out_keys=[keys.OBSERVATION])
        if form not in OBSERVATIONS:
            raise UserError(f"observation.form={form!r} is unknown; choose one of {', '.join(OBSERVATIONS)}.")
        if vehicles < 2:
            raise UserError(f"vehicles={vehicles}: an observation is of at least one other vehicle; give 2 or more.")
        self.road, self.vehicles, self.form = road, vehicles, form
        self.scale = scale or ObservationScale()

    def observe(
        self, vehicles: Vehicles, progress: Tensor, direction: Tensor, road: Road, seen: Vehicles | None = None
    ) -> Tensor:
        """The observation [N, D].

        Args:
            vehicles: the true state; without ``seen`` also what the ego sees of the others.
            progress, direction: of the ego's own lane change, [N].
            road: where it drives.
            seen: the others as the ego perceives them, and where it was itself when it did (column 0).
        """
        seen = vehicles if seen is None else seen
        form = OBSERVATIONS[self.form]
        others = other_vehicles(seen, road, self.scale)
        parts = [own_state(vehicles, road)]
        if form.listed:
            parts.append(as_list(nearest_first(others, distance_to_ego(seen, road))))
        if form.viewed:
            parts.append(lane_view(others, road.lanes, self.scale, form.drift, form.overlap))
        if form.progress:
            parts.append(torch.stack((progress, direction.to(progress.dtype)), dim=1))
        return torch.cat(parts, dim=1)

    def compile_graphs(self) -> None:
        """Make one graph of the observation (``env.compile=true``)."""
        self.observe = compiled(self.observe)  # type: ignore[method-assign]

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        vehicles, ego = Vehicles.of(tensordict.get(keys.VEHICLES)), tensordict.get(keys.EGO)
        road = road_in(tensordict, self.road)
        observation = self.observe(
            vehicles, ego.get("change_progress"), ego.get("change_direction"), road, perceived(tensordict, vehicles)
        )
        return tensordict.set(keys.OBSERVATION, observation)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._write(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``observation`` into any TensorDict that holds the raw state."""
        return self._write(tensordict)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``observation`` to the spec."""
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, observation_size(self.form, self.vehicles))
        dtype = observation_spec[keys.VEHICLES, "x"].dtype
        observation_spec[keys.OBSERVATION] = Unbounded(shape=shape, dtype=dtype, device=observation_spec.device)
        return observation_spec
