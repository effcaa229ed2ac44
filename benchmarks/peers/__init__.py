"""The same drivers in ganlane, HighwayEnv and SUMO, side by side (docs/peers.md).

    python -m benchmarks.peers.compare

``scene`` is what is driven and the plain equations; ``simulators`` drive it; ``tolerance`` derives
by how much they may differ; ``compare`` measures, ``report`` prints and draws.
"""
