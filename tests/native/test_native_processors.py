"""An Arm processor, here an emulated one, drives the same episodes as this one, bit for bit."""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ganlane.native.batch import NativeBatch
from ganlane.native.drivers import Human, drivers_of, parts_of
from ganlane.native.library import FLAGS, why_not
from ganlane.native.settings import Layout
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.record import make
from ganlane.settings.traffic import TrafficConfig

EMULATOR = shutil.which("qemu-aarch64")
HERE = Path(__file__).parent
KERNEL = HERE.parents[1] / "ganlane" / "native"
ROWS, DECISIONS = 6, 8
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(why_not() is not None, reason="no C++ compiler"),
    pytest.mark.skipif(EMULATOR is None, reason="qemu-aarch64 is not installed"),
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="ziglang is not installed"
    ),
]


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The kernel and a main function, for an Arm processor."""
    path = tmp_path_factory.mktemp("arm") / "decide"
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
    compiler = [sys.executable, "-m", "ziglang", "c++", "-target", "aarch64-linux-musl", "-static"]
    sources = [str(HERE / "decide_elsewhere.cpp"), f"-I{KERNEL}", "-DLANES=4"]
    subprocess.run([*compiler, *flags, *sources, "-o", str(path)], check=True)
    return path


def described(batch, layout):
    """The state before a decision, as decide_elsewhere.cpp reads it."""
    settings = batch._parts[0].pointed["settings"]
    names = list(batch.state)
    parts = [struct.pack("qqq", ROWS, DECISIONS, len(names))]
    human = next((one for one in settings.pointed if isinstance(one, Human)), None)
    kind = type(settings)
    alone = kind.from_buffer_copy(settings)
    for name in ("generated", "human", "faults", "random", "ends"):
        setattr(alone, name, None)
    parts += [struct.pack("q", ctypes.sizeof(kind)), bytes(alone)]
    if human is None:
        parts.append(struct.pack("q", 0))
    else:
        sizes = struct.pack("qq", len(human.packed), ctypes.sizeof(human))
        parts += [sizes, bytes(human), human.packed.tobytes()]
    for name in names:
        numbers = batch.state[name].tobytes()
        parts += [struct.pack("q", len(numbers)), numbers]
    for side in (layout.inputs, layout.outputs):
        places = [names.index(name) if name in batch.state else -1 for name in side]
        parts.append(struct.pack(f"{len(places) + 1}q", len(places), *places))
    return b"".join(parts)


@pytest.mark.parametrize("traffic", ["idm", "idm_mobil", "human"])
def test_an_arm_processor_drives_the_same_episodes(traffic, program, tmp_path):
    drivers = drivers_of(make(TrafficConfig, traffic), IdmParameters(), MobilParameters(), 0)
    batch = NativeBatch(ROWS, drivers=drivers)
    batch.start(0, np.arange(ROWS))
    batch.state["action"][:] = [0, 1, 2, 0, 0, 1]
    # Rows that end stay as they are, here and there.
    (part,) = parts_of(drivers)
    before, after = tmp_path / "before", tmp_path / "after"
    before.write_bytes(described(batch, Layout(part.memory)))
    subprocess.run([EMULATOR, str(program), str(before), str(after)], check=True)
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
