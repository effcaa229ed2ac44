"""A training run of seconds, for the tests of whole commands.

Who else drives in its table, each of them says.
"""

TINY = [
    "env.goal_m=40",
    "traffic=idm",
    "init=none",
    "agent=rainbow",
    "observation=table3_progress",
    "total_decisions=320",
    "log_every=160",
    "num_envs=16",
    "agent.hidden=[16,16]",
    "agent.batch_size=32",
    "agent.warmup=64",
    "agent.capacity=1000",
    "evaluation.episodes=2",
]
