"""A pretended GPU: tensors with a device but without numbers, on a machine that has no GPU.

As a program it drives a mixture of all traffics and a training on it, and prints as JSON for what
a GPU's host would have waited. Its device, ``gpu``, is PyTorch's place for backends that are
written in Python; it cannot be taken back, so a process of its own has it.
"""

from __future__ import annotations

import json
import traceback
from collections import Counter
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

_setup_privateuseone_for_python_backend("gpu")
GPU = torch.device("gpu:0")
#: Traffics that the package has without recordings or other simulators.
TRAFFICS = ("idm", "idm_mobil", "idm_random", "idm_faults", "gan", "gan_calibrated")
#: One of each traffic where they are mixed.
ROWS = len(TRAFFICS)
#: The tensor code, of which one physics step is as the other.
OPTIONS: dict[str, Any] = {"kernel": "torch", "decision_period_s": 0.1}
#: Operations whose result the host reads, or whose shape depends on it.
READS = ("_local_scalar_dense", "nonzero", "equal", "masked_select", "_unique2", "bincount")
#: Packages of which the innermost line is named.
SOURCES = ("/ganlane/", "/torchrl/", "/tensordict/")


def place() -> str:
    """File and function of the innermost line of :data:`SOURCES`."""
    for frame in reversed(traceback.extract_stack()):
        for source in SOURCES:
            if source in frame.filename:
                return f"{source[1:]}{frame.filename.rpartition(source)[2]} {frame.name}"
    return "elsewhere"


class Waits(TorchDispatchMode):
    """Counts what makes the host wait for the GPU, by operation and place; gives dummy results."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def count(self, what: str) -> None:
        self.counts[f"{what} in {place()}"] += 1

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        name = func._schema.name.removeprefix("aten::")
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        on_gpu = any(tensor.device == GPU for tensor in tensors)
        if name in READS and (on_gpu or name == "_local_scalar_dense"):
            if on_gpu:
                self.count(name)
            if name == "_local_scalar_dense":
                return 0
            if name == "equal":
                return False
            raise AssertionError(f"the shape of {name} depends on numbers: {self.counts}")
        # Indexing by flags is nonzero() and then indexing.
        if name in ("index", "index_put", "index_put_") and on_gpu:
            kinds = {index.dtype for index in args[1] if index is not None}
            if torch.bool in kinds:
                self.count("indexing by flags")
        if name == "_to_copy" and tensors:
            device = kwargs.get("device")
            if device is not None and torch.device(device).type != tensors[0].device.type:
                self.count("copy to the host" if on_gpu else "copy from the host")
                if not on_gpu:
                    dtype = kwargs.get("dtype") or tensors[0].dtype
                    return torch.empty(tensors[0].shape, dtype=dtype, device=GPU)
        if name == "copy_" and len({tensor.device.type for tensor in tensors}) > 1:
            self.count("copy between host and GPU")
            return args[0]
        return func(*args, **kwargs)


class Generator(torch.Generator):
    """The host's, said to be on the GPU."""

    device = GPU

    def __new__(cls, device: Any = None) -> Generator:
        return super().__new__(cls)

    def manual_seed(self, seed: int) -> Generator:
        super().manual_seed(seed)
        return self


def to(self: nn.Module, *arguments: Any, **named: Any) -> nn.Module:
    """``nn.Module.to``, which cannot move such tensors."""
    device, dtype, *_ = torch._C._nn._parse_to(*arguments, **named)
    for module in self.modules():
        tensors = [*module.named_parameters(recurse=False), *module.named_buffers(recurse=False)]
        for name, tensor in tensors:
            kind = dtype if tensor.is_floating_point() else None
            moved = torch.empty_like(tensor, device=device, dtype=kind)
            setattr(module, name, nn.Parameter(moved) if name in module._parameters else moved)
    return self


def tolist(self: Tensor) -> list[int]:
    """Of the rows of each part of a mixed traffic: equally many."""
    MODE.count("tolist")
    return [ROWS // len(self)] * len(self)


def numpy(self: Tensor) -> Any:
    """Zeros, of a tensor that the host has."""
    assert self.device.type == "cpu"
    with _disable_current_modes():
        return torch.zeros(self.shape, dtype=self.dtype).numpy()


def waits() -> dict[str, int]:
    """The counts since the last call, without the constants, which are made once."""
    counts = {what: count for what, count in MODE.counts.items() if "_constant" not in what}
    MODE.counts.clear()
    return counts


def elsewhere(tensordict: Any) -> list[str]:
    """Names of the tensors that are not on the GPU."""
    leaves = tensordict.items(True, True)
    return [str(name) for name, tensor in leaves if tensor.device != GPU]


def drive() -> dict[str, Any]:
    """A reset and a decision of one physics step, in a mixture of all :data:`TRAFFICS`."""
    mixed = {"name": "mixed", "shares": dict.fromkeys(TRAFFICS, 1)}
    config = highways(traffic=mixed, num_envs=ROWS, mask="safe", recycle=True, **OPTIONS)
    # Weights are read from files, with their numbers.
    with _disable_current_modes():
        model = make_traffic(config.traffic, config.env)
    assign(config, device="gpu")
    env = make_env(model, config, ROWS)
    waits()
    state = env.reset()
    reset = waits()
    state["action"] = torch.zeros(ROWS, dtype=torch.int64, device=GPU)
    after = env.step(state)["next"]
    lost = elsewhere(state) + elsewhere(after)
    return {"reset": reset, "decision": waits(), "elsewhere": lost}


def learn() -> dict[str, Any]:
    """Steps of a training: policy, environment, window, buffer, loss and update."""
    config = highways(traffic="idm", num_envs=ROWS, **OPTIONS)
    traffic = make_traffic(config.traffic, config.env)
    assign(config, device="gpu")
    env = make_env(traffic, config, ROWS)
    small = RainbowConfig(hidden=[8], capacity=256, batch_size=4, warmup=4, n_step=2)
    agent = Rainbow(small, 29, device=GPU)
    collector = Collector(env)
    window = NStepWindow(small.n_step, small.gamma)
    # A window of two steps fills the buffer from the second on, which then takes its shape.
    for _ in range(3):
        waits()
        step = collector.step(agent, lambda: None)
        collect = waits()
        agent.store(window.push(step))
        store = waits()
    agent.update()
    lost = elsewhere(step) + elsewhere(agent.replay[:])
    return {"collect": collect, "store": store, "update": waits(), "elsewhere": lost}


if __name__ == "__main__":
    from ganlane.agents import NStepWindow, Rainbow, RainbowConfig
    from ganlane.build import make_env, make_traffic
    from ganlane.settings.commands import highways
    from ganlane.settings.record import assign
    from ganlane.sim.spawn import RandomScenes
    from ganlane.training.collectors import Collector

    nn.Module.to = to
    FakeTensor.tolist = tolist
    FakeTensor.numpy = numpy
    torch.Generator = Generator
    torch.gpu.synchronize = lambda: MODE.count("synchronize")
    # A tensor of the host's numbers is made there and then copied, which is counted.
    torch._C._set_only_lift_cpu_tensors(True)
    torch.set_num_threads(1)
    # It drives braking cars, whose numbers matter.
    RandomScenes.check = lambda *parts: None
    MODE = Waits()
    with FakeTensorMode(allow_non_fake_inputs=True), MODE:
        report = {"mixed": drive(), "training": learn()}
    print(json.dumps(report))
