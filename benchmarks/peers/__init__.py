"""The same drivers in ganlane, HighwayEnv and SUMO, side by side (docs/peers.md).

    python -m benchmarks.peers.compare

``scene`` says what is driven; ``ours``, ``highway_env_peer`` and ``sumo_peer`` drive it; ``simulators`` lists them.
``schemes`` holds the one model with each simulator's way of integrating it, ``tolerance`` derives by how much they
may differ, and ``compare`` puts them beside each other. ``plot`` and ``report`` draw and print.
"""
