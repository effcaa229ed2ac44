"""Root of ``ganlane evaluate``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.env import EnvConfig, check_pay
from ganlane.config.observation import ObservationConfig
from ganlane.config.run import GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.config.traffic_foreign import HighwayEnvTrafficConfig, SumoTrafficConfig
from ganlane.config.traffic_mixed import MixedTrafficConfig, reacting_traffics
from ganlane.config.traffic_replay import ReplayTrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import Rule, at_least, between, check, did_you_mean, one_of
from ganlane.parameters.observation import MaskParameters
from ganlane.parameters.reward import RewardParameters

#: Families of episodes that can be driven for a table: to choose on, to report on.
STREAMS = ("report", "select")
#: A list of names without repetitions.
NAMES = Rule(lambda names: len(names) > 0 and len(set(names)) == len(names), "a list of different names, not empty")


def all_traffics() -> dict[str, TrafficConfig]:
    """The options of the group ``traffic``, by name."""
    return {
        **reacting_traffics(),
        "mixed": MixedTrafficConfig(),
        "replay": ReplayTrafficConfig(),
        "sumo": SumoTrafficConfig(),
        "highway_env": HighwayEnvTrafficConfig(),
    }


@dataclass
class EvaluateConfig(RunConfig):
    """Agents x traffics, the same episodes for all of them."""

    agents: list[str] = field(default_factory=lambda: ["mobil", "keep_lane", "random_legal", "agent_idm"])
    traffics: list[str] = field(default_factory=lambda: ["idm", "idm_mobil", "gan", "gan_calibrated"])
    episodes: int = 100
    num_envs: int = 512
    stream: str = "report"
    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    traffic_options: dict[str, TrafficConfig] = field(default_factory=all_traffics)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "", agents=NAMES, traffics=NAMES, episodes=at_least(1), num_envs=between(1, 65536))
        check(self, "", stream=one_of(STREAMS))
        check_pay(self.env, self.reward)
        self.chosen_traffics()

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """The traffics asked for, by name: options of the group, or import paths of a user's own."""
        for name in self.traffics:
            if name not in self.traffic_options and "." not in name:
                known = ", ".join(self.traffic_options)
                raise UserError(
                    f"traffics={name}: no such traffic{did_you_mean(name, self.traffic_options)}; choose among "
                    f"{known}, or give the import path of a model of your own."
                )
        return {name: self.traffic_options.get(name) or TrafficConfig(_target_=name) for name in self.traffics}
