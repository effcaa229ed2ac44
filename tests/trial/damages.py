"""Ways to damage a file: bytes, its text, or one of its values where its format is known."""

from __future__ import annotations

import io
import json
import pickle
import random
import re
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import polars as pl
import torch
from reference.refusals import Bomb

Damage = Callable[[random.Random, bytes], bytes]

_NUMBERS = """
nan inf -inf 1e308 -1e308 1e999 -1 0 -0.0 1e-320 0x10 1,5 1_000 null true [] {} --1 1e
9223372036854775808 -18446744073709551616 \uff11\uff12
"""
_NAMES = """
../../../etc/passwd /dev/zero __class__ __reduce__ os.system ${oc.env:HOME} %s%n x=1 a.b.c é
!!python/object/apply:os.system C:\\nul ';DROP
"""
#: What stands in a file by mistake or malice instead of a number, and instead of a name.
NUMBERS = [*_NUMBERS.split(), "9" * 400, "9" * 6000, "", " ", "\x00"]
NAMES = [*_NAMES.split(), "a" * 10**6, "", "\x00", "\ud7ff"]
#: Values for JSON, YAML and checkpoints.
VALUES: list[Any] = [None, True, -1, 0, -0.5, 2**63, 10**12, 10**400, 1e308]
VALUES += [float("nan"), float("inf"), "", "many", "../x", "\x00", ["x"] * 1000]
VALUES += [[], {}, [[]], {"a": {"b": []}}]


def flip(rng: random.Random, whole: bytes) -> bytes:
    """One to eight bits flipped."""
    changed = bytearray(whole)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(rng: random.Random, whole: bytes) -> bytes:
    """The end is missing."""
    return whole[: rng.randrange(len(whole))]


def block(rng: random.Random, whole: bytes) -> bytes:
    """A block is zeros, noise, missing, there twice, or has more behind it."""
    start = rng.randrange(len(whole))
    size = rng.choice((1, 16, 512, 4096))
    part = whole[start : start + size]
    noise = rng.randbytes(len(part))
    new = rng.choice((bytes(len(part)), noise, b"", part * 2, part + noise))
    return whole[:start] + new + whole[start + len(part) :]


def _written(write: Callable[[io.BytesIO], Any]) -> bytes:
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def _archive(file: io.BytesIO) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("../../x", b"0" * 100)


#: Other formats altogether.
FOREIGN = (
    b"",
    bytes(range(256)) * 16,
    b"\x89PNG\r\n\x1a\n" + bytes(99),
    b"{}",
    b"[" * 100_000,
    b'{"a":' * 5000,
    b"\xff\xfe" + "x,y\n1,2\n".encode("utf-16-le"),
    b"PAR1" + bytes(64) + b"PAR1",
    b"\xef\xbb\xbf",
    (2**62).to_bytes(8, "little") + b"{}",
    b"a" * 10**6,
    b"- !!python/object/apply:os.system [echo]\n",
    b"&a [*a]\n",
    pickle.dumps(Bomb()),
    _written(_archive),
    _written(lambda file: torch.save({"kind": "ganlane training checkpoint", "x": Bomb()}, file)),
    _written(lambda file: np.savez(file, labels=np.array([Bomb()], dtype=object))),
)


def foreign(rng: random.Random, whole: bytes) -> bytes:
    """Another format altogether."""
    return rng.choice(FOREIGN)


def number(rng: random.Random, whole: bytes) -> bytes:
    """A hostile number in place of one."""
    return _replaced(rng, whole, rb"-?\d+(\.\d+)?(e-?\d+)?", NUMBERS)


def name(rng: random.Random, whole: bytes) -> bytes:
    """A hostile name in place of one."""
    return _replaced(rng, whole, rb"[A-Za-z_][A-Za-z_.]+", NAMES)


def _replaced(rng: random.Random, whole: bytes, pattern: bytes, choices: list[str]) -> bytes:
    # Most of a table is rows; half of the time its beginning is chosen.
    places = list(re.finditer(pattern, whole[: rng.choice((400, len(whole)))]))
    if not places:
        return cut(rng, whole)
    place = rng.choice(places)
    new = rng.choice(choices).encode("utf-8", "surrogatepass")
    return whole[: place.start()] + new + whole[place.end() :]


def line(rng: random.Random, whole: bytes) -> bytes:
    """A line of a text is missing, there twice or very often, elsewhere, or longer."""
    lines = whole.splitlines(keepends=True)
    chosen = rng.randrange(min(len(lines), rng.choice((3, len(lines)))))
    text = lines.pop(chosen)
    longer = text.rstrip(b"\r\n") + b",1,2\n"
    times, new = rng.choice(((0, text), (2, text), (10, text), (20_000, text), (1, longer)))
    place = rng.choice((chosen, rng.randrange(len(lines) + 1)))
    return b"".join([*lines[:place], *[new] * times, *lines[place:]])


def in_json(rng: random.Random, whole: bytes) -> bytes:
    """Another value, a missing key or a further one somewhere in JSON."""
    return json.dumps(_mutated(rng, json.loads(whole))).encode("utf-8", "surrogatepass")


def in_safetensors(rng: random.Random, whole: bytes) -> bytes:
    """The same in a safetensors header, with its length put right; mostly in our part of it."""
    size = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + size])
    if rng.random() < 0.7:
        ours = json.loads(header["__metadata__"]["ganlane"])
        header["__metadata__"]["ganlane"] = json.dumps(_mutated(rng, ours))
    else:
        header = _mutated(rng, header)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + whole[8 + size :]


def in_torch(rng: random.Random, whole: bytes) -> bytes:
    """The same in what ``torch.save`` wrote, tensors included."""
    content = _mutated(rng, torch.load(io.BytesIO(whole), weights_only=True))
    return _written(lambda file: torch.save(content, file))


def in_parquet(rng: random.Random, whole: bytes) -> bytes:
    """A column of a Parquet file with another name or other values, or none; other rows."""
    frame = pl.read_parquet(io.BytesIO(whole))
    chosen = rng.choice(frame.columns)
    values = (None, float("nan"), float("inf"), 1e308, -(2**62), 0, "x")
    new = (
        frame.drop(chosen),
        frame.rename({chosen: rng.choice(NAMES)[:1000]}),
        frame.head(rng.randrange(2)),
        pl.concat([frame, frame]),
        frame.with_columns(pl.lit(rng.choice(values)).alias(chosen)),
        frame.with_columns(pl.col(chosen).shuffle(seed=rng.randrange(99))),
    )
    return _written(rng.choice(new).write_parquet)


def _mutated(rng: random.Random, content: Any) -> Any:
    """A copy in which one place, however deep, holds something else."""
    if isinstance(content, dict) and content and rng.random() < 0.95:
        copy = dict(content)
        chosen = rng.choice(list(content))
        sort = rng.random()
        if sort < 0.1:
            del copy[chosen]
        elif sort < 0.2:
            copy[rng.choice(NAMES)[:1000]] = rng.choice(VALUES)
        else:
            copy[chosen] = _mutated(rng, content[chosen])
        return copy
    if isinstance(content, list) and content and rng.random() < 0.8:
        items = list(content)
        chosen = rng.randrange(len(items))
        items[chosen] = _mutated(rng, items[chosen])
        return items
    if isinstance(content, torch.Tensor) and rng.random() < 0.7:
        flat = content.reshape(-1)
        return rng.choice((flat[:0], flat[:-1], content.double() * float("nan"), content[None]))
    return rng.choice(VALUES)


BYTES: tuple[Damage, ...] = (flip, flip, cut, block, foreign)
TEXT: tuple[Damage, ...] = (flip, cut, block, foreign, number, number, name, line, line)
