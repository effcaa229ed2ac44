# ruff: noqa: F401  (the names that other parts of the package and users import from here)
"""The agent: Rainbow (Hessel et al. 2018) from TorchRL parts.

A decision flows through the files in this order: :mod:`~ganlane.agents.network` turns an
observation into a distribution over returns for each action, :mod:`~ganlane.agents.drivers` picks
one (and holds the drivers that need no learning), :mod:`~ganlane.agents.n_step` joins n decisions
into a transition, :mod:`~ganlane.agents.replay` keeps it and draws it again by priority,
:mod:`~ganlane.agents.loss` compares it with the target network, and :mod:`~ganlane.agents.rainbow`
holds it all together. :mod:`~ganlane.agents.checkpoint` writes the trained network to a file, reads
it back, and starts another agent from it.
"""

from ganlane.agents.checkpoint import agent_file, load_agent, read_agent, save_agent, warm_start
from ganlane.agents.drivers import ExploringPolicy, GreedyPolicy
from ganlane.agents.n_step import NStepWindow
from ganlane.agents.network import NetworkConfig, QNetwork
from ganlane.agents.rainbow import Rainbow
from ganlane.settings.agent import RainbowConfig
