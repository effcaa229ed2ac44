"""Emulated processors drive the same episodes as this one, bit for bit: Arm, older x86."""

import ctypes
import importlib.util
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ganlane.native.batch import NativeBatch
from ganlane.native.drivers import drivers_of, parts_of
from ganlane.native.library import FLAGS, VARIANTS
from ganlane.native.settings import Highway, Layout, ends_of
from ganlane.settings.commands import highways
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.record import make
from ganlane.settings.road import WALL, LaneStretch
from ganlane.settings.traffic import TrafficConfig

HERE = Path(__file__).parent
KERNEL = HERE.parents[1] / "ganlane" / "native"
ROWS, DECISIONS = 6, 8
#: Structures that the settings point to, in the order in which decide_elsewhere.cpp reads them.
POINTED = ("generated", "human", "faults", "random", "ends")
#: The left lane of three ends where cars that start near the ego soon come to.
LANE_DROP = (LaneStretch(), LaneStretch(), LaneStretch(end_m=150.0, end=WALL))


class Processor(NamedTuple):
    """What the kernel is compiled for, by which of its variants, and what it is driven by."""

    target: str
    variant: str
    emulator: tuple[str, ...]

    def command(self):
        """The emulator, by its usual or by its statically linked name; None if not installed."""
        name, *options = self.emulator
        path = shutil.which(name) or shutil.which(f"{name}-static")
        return None if path is None else [path, *options]


PROCESSORS = {
    "64-bit Arm": Processor("aarch64-linux-musl", "default", ("qemu-aarch64",)),
    "x86 without AVX": Processor("x86_64-linux-musl", "default", ("qemu-x86_64", "-cpu", "qemu64")),
    "x86 with AVX2": Processor("x86_64-linux-musl", "AVX2", ("qemu-x86_64", "-cpu", "Haswell")),
}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.kernel,
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed"
    ),
]


@pytest.fixture(scope="module", params=PROCESSORS)
def program(request, tmp_path_factory):
    """The kernel and a main function for another processor, as a command that drives them."""
    processor = PROCESSORS[request.param]
    command = processor.command()
    if command is None:
        pytest.skip(f"{processor.emulator[0]} is not installed")
    path = tmp_path_factory.mktemp("elsewhere") / "decide"
    variant = VARIANTS[processor.variant]
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
    compiler = [sys.executable, "-m", "ziglang", "c++", "-target", processor.target, "-static"]
    sources = [str(HERE / "decide_elsewhere.cpp"), f"-I{KERNEL}", f"-DLANES={variant.lanes}"]
    arguments = [*compiler, *flags, *variant.flags, *sources, "-o", str(path)]
    subprocess.run(arguments, check=True)
    return [*command, str(path)]


def described(batch, layout):
    """The state before a decision, as decide_elsewhere.cpp reads it."""
    settings = batch._parts[0].batch.pointed["settings"]
    names = list(batch.state)
    parts = [struct.pack("qqq", ROWS, DECISIONS, len(names))]
    kind = type(settings)
    parts += [struct.pack("q", ctypes.sizeof(kind)), bytes(settings)]
    for name in POINTED:
        structure = settings.pointed[name]
        if structure is None:
            parts.append(struct.pack("qq", 0, 0))
            continue
        network = structure.pointed.get("network", structure)
        weights = network.pointed.get("weights")
        count = 0 if weights is None else len(weights)
        parts += [struct.pack("qq", ctypes.sizeof(structure), count), bytes(structure)]
        if weights is not None:
            parts.append(weights.tobytes())
    for name in names:
        numbers = batch.state[name].tobytes()
        parts += [struct.pack("q", len(numbers)), numbers]
    for side in (layout.inputs, layout.outputs):
        places = [names.index(name) if name in batch.state else -1 for name in side]
        parts.append(struct.pack(f"{len(places) + 1}q", len(places), *places))
    return b"".join(parts)


@pytest.mark.parametrize("ends", [(), LANE_DROP], ids=["highway", "lane_drop"])
@pytest.mark.parametrize(
    "traffic", ["idm", "idm_mobil", "idm_faults", "idm_random", "gan", "gan_calibrated", "human"]
)
def test_another_processor_drives_the_same_episodes(traffic, ends, program, tmp_path):
    drivers = drivers_of(make(TrafficConfig, traffic), IdmParameters(), MobilParameters(), 0)
    batch = NativeBatch(highways(num_envs=ROWS), drivers)
    settings = batch._parts[0].batch.pointed["settings"]
    if ends:
        settings.pointed["ends"] = ends_of(ends)
        settings.ends = ctypes.addressof(settings.pointed["ends"])
    batch.start(0, np.arange(ROWS))
    batch.state["action"][:] = [0, 1, 2, 0, 0, 1]
    # Rows that end stay as they are, here and there.
    (part,) = parts_of(drivers)
    before, after = tmp_path / "before", tmp_path / "after"
    before.write_bytes(described(batch, Layout(part.memory, Highway())))
    subprocess.run([*program, str(before), str(after)], check=True)
    for _ in range(DECISIONS):
        batch._parts[0].drive(batch._library.ganlane_decide, ROWS)
    there = after.read_bytes()
    at = 0
    for name, array in batch.state.items():
        numbers = np.frombuffer(there[at : at + array.nbytes], array.dtype).reshape(array.shape)
        at += array.nbytes
        np.testing.assert_array_equal(numbers, array, str(name))
    assert at == len(there)
    assert (batch.state["step"] > 0).any()
