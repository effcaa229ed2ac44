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

Damage = Callable[[random.Random, bytes], bytes]

#: What stands in a file by mistake or malice instead of a number.
NUMBERS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e308",
        "-1e308",
        "1e999",
        "-1",
        "0",
        "-0.0",
        "1e-320",
        "9" * 400,
        "9" * 6000,
        "0x10",
    ),
    *(
        "1,5",
        "1_000",
        "\uff11\uff12",
        "",
        " ",
        "null",
        "true",
        "[]",
        "{}",
        "--1",
        "1e",
        "\x00",
        str(2**63),
        str(-(2**64)),
    ),
)
#: The same for names and texts.
NAMES = (
    *(
        "../../../etc/passwd",
        "/dev/zero",
        "__class__",
        "__reduce__",
        "a" * 10**6,
        "",
        "\x00",
        "'; DROP TABLE x",
        "é",
    ),
    *(
        "os.system",
        "!!python/object/apply:os.system",
        "${oc.env:HOME}",
        "%s%n",
        "\ud7ff",
        "x=1",
        "a.b.c",
        "C:\\nul",
    ),
)
#: Values for JSON, YAML and checkpoints.
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        -1,
        0,
        2**31,
        2**63,
        10**400,
        1e308,
        float("nan"),
        float("inf"),
        "",
        "many",
        [],
        {},
        [[]],
        -0.5,
    ),
    *([None] * 3, {"a": {"b": []}}, "../x", ["x"] * 1000, "\x00", 10**12),
)


class Bomb:
    """Unpickling it would print a line; nothing of ours may."""

    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("EXECUTED",)


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
    new = rng.choice(
        (bytes(len(part)), rng.randbytes(len(part)), b"", part * 2, part + rng.randbytes(size))
    )
    return whole[:start] + new + whole[start + len(part) :]


def foreign(rng: random.Random, whole: bytes) -> bytes:
    """Another format altogether."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("../../x", b"0" * 100)
    made = io.BytesIO()
    torch.save({"kind": "ganlane training checkpoint", "version": 2, "state": Bomb()}, made)
    objects = io.BytesIO()
    np.savez(objects, labels=np.array([Bomb()], dtype=object))
    choices = (
        *(
            b"",
            b"\x00",
            bytes(range(256)) * 16,
            b"\x89PNG\r\n\x1a\n" + rng.randbytes(99),
            b"PK\x03\x04",
            b"{}",
            b"[]",
        ),
        *(
            b"null",
            b"[" * 100_000,
            b'{"a":' * 5000,
            b"\xff\xfe" + "x,y\n1,2\n".encode("utf-16-le"),
            b"\x1f\x8b\x08",
        ),
        *(
            b"\x7fELF" + rng.randbytes(99),
            b"PAR1" + rng.randbytes(64) + b"PAR1",
            b"x,y\n",
            b"\xef\xbb\xbf",
            b"\n" * 999,
        ),
        *(
            (2**62).to_bytes(8, "little") + b"{}",
            b"\x93NUMPY" + rng.randbytes(64),
            b"a" * 10**6,
            b"," * 10**5,
        ),
        *(
            b"- !!python/object/apply:os.system [echo]\n",
            b"&a [*a]\n",
            b"<html></html>",
            pickle.dumps(Bomb()),
        ),
        *(archive.getvalue(), made.getvalue(), objects.getvalue()),
    )
    return rng.choice(choices)


def number(rng: random.Random, whole: bytes) -> bytes:
    """A hostile number in place of one or all numbers of a column's worth."""
    return _replaced(rng, whole, rb"-?\d+(\.\d+)?(e-?\d+)?", NUMBERS)


def name(rng: random.Random, whole: bytes) -> bytes:
    """A hostile name in place of one."""
    return _replaced(rng, whole, rb"[A-Za-z_][A-Za-z_.]+", NAMES)


def _replaced(rng: random.Random, whole: bytes, pattern: bytes, choices: tuple[str, ...]) -> bytes:
    # Most of a table is rows; half of the time its beginning is chosen.
    found = list(re.finditer(pattern, whole[: rng.choice((400, len(whole)))]))
    if not found:
        return cut(rng, whole)
    chosen = rng.choice(found)
    new = rng.choice(choices).encode("utf-8", "surrogatepass")
    return whole[: chosen.start()] + new + whole[chosen.end() :]


def line(rng: random.Random, whole: bytes) -> bytes:
    """A line of a text is missing, there twice, in another place, longer, or there very often."""
    lines = whole.splitlines(keepends=True)
    chosen = rng.randrange(min(len(lines), rng.choice((3, len(lines)))))
    sort = rng.randrange(5)
    if sort == 0:
        del lines[chosen]
    elif sort == 1:
        lines.insert(chosen, lines[chosen])
    elif sort == 2:
        lines.insert(rng.randrange(len(lines)), lines.pop(chosen))
    elif sort == 3:
        lines[chosen] = lines[chosen].rstrip(b"\r\n") + b",1,2\n"
    else:
        lines.extend([lines[chosen]] * rng.choice((10, 20_000)))
    return b"".join(lines)


def in_json(rng: random.Random, whole: bytes) -> bytes:
    """Another value, a missing key or a further one somewhere in JSON."""
    content = _mutated(rng, json.loads(whole))
    return json.dumps(content).encode("utf-8", "surrogatepass")


def in_safetensors(rng: random.Random, whole: bytes) -> bytes:
    """The same in our part of a safetensors header, with its length put right."""
    size = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + size])
    if rng.random() < 0.7:
        header["__metadata__"]["ganlane"] = json.dumps(
            _mutated(rng, json.loads(header["__metadata__"]["ganlane"]))
        )
    else:
        header = _mutated(rng, header)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + whole[8 + size :]


def in_torch(rng: random.Random, whole: bytes) -> bytes:
    """The same in what ``torch.save`` wrote, tensors included."""
    content = _mutated(rng, torch.load(io.BytesIO(whole), weights_only=True))
    made = io.BytesIO()
    torch.save(content, made)
    return made.getvalue()


def in_parquet(rng: random.Random, whole: bytes) -> bytes:
    """A column of a Parquet file with another name, type or values, or none."""
    frame = pl.read_parquet(io.BytesIO(whole))
    chosen = rng.choice(frame.columns)
    column = pl.col(chosen)
    new = (
        column.cast(pl.String),
        *(
            pl.lit(value).alias(chosen)
            for value in (None, float("nan"), float("inf"), 1e308, -(2**62), 0, "x")
        ),
        column.cast(pl.Float64, strict=False) * -1e6,
        column.shuffle(seed=rng.randrange(99)),
    )
    sort = rng.randrange(4)
    if sort == 0:
        frame = frame.drop(chosen)
    elif sort == 1:
        frame = frame.rename({chosen: rng.choice(NAMES)[:1000]})
    elif sort == 2:
        frame = rng.choice(
            (frame.head(0), frame.head(1), pl.concat([frame, frame]), frame.reverse())
        )
    else:
        frame = frame.with_columns(rng.choice(new))
    made = io.BytesIO()
    frame.write_parquet(made)
    return made.getvalue()


def _mutated(rng: random.Random, content: Any) -> Any:
    """A copy in which one place, however deep, holds something else."""
    if isinstance(content, dict) and content and rng.random() < 0.95:
        chosen = rng.choice(list(content))
        sort = rng.random()
        if sort < 0.1:
            return {key: value for key, value in content.items() if key != chosen}
        if sort < 0.2:
            return {**content, rng.choice(NAMES)[:1000]: rng.choice(VALUES)}
        return {**content, chosen: _mutated(rng, content[chosen])}
    if isinstance(content, list) and content and rng.random() < 0.8:
        chosen = rng.randrange(len(content))
        return [*content[:chosen], _mutated(rng, content[chosen]), *content[chosen + 1 :]]
    if isinstance(content, torch.Tensor) and rng.random() < 0.7:
        flat = content.reshape(-1)
        return rng.choice(
            (flat[:0], flat[:-1], content.double() * float("nan"), content.long(), content[None])
        )
    return rng.choice(VALUES)


BYTES: tuple[Damage, ...] = (flip, flip, cut, block, foreign)
TEXT: tuple[Damage, ...] = (flip, cut, block, foreign, number, number, name, line, line)
