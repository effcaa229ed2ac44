"""Digests of what the package gives, which most changes should leave as they are."""

import torch
from reference.refusals import user_error

from benchmarks.nets import compare, digest, rollout


def test_a_digest_tells_values_shapes_and_types_apart():
    ones = torch.ones(2, 3)
    others = [ones.T, ones.double(), torch.nextafter(ones, ones + 1), "ones"]
    assert digest(ones) == digest(torch.ones(2, 3))
    assert digest(ones) not in [digest(other) for other in others]


def test_a_rollout_has_the_same_digests_again_and_others_on_another_road():
    first = rollout(traffic="idm", mask="safe")
    assert compare(first, rollout(traffic="idm", mask="safe")).startswith(f"all {len(first)}")
    with user_error(r"'x'\) +differs"):
        compare(first, rollout(traffic="idm", mask="safe", lanes=2))
    with user_error("gone"):
        compare(first, {})
