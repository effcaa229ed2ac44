"""What all transforms of the environment have in common."""

from __future__ import annotations

from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from ganlane.env.state import spec_of


class StateTransform(Transform):
    """Base of the transforms that add keys to a state; the spec follows from what a reset adds."""

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add what a reset adds to a state of zeros."""
        assert isinstance(observation_spec, Composite)
        state = observation_spec.zero()
        added = self._reset(state, state.copy()).exclude(*state.keys())
        observation_spec.update(spec_of(added).to(observation_spec.device))
        return observation_spec
