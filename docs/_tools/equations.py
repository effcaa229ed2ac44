"""Equations between double dollar signs become MathML, which browsers show without a script or a
network.

A hook of MkDocs (``mkdocs.yml``). Within code, dollar signs stay what they are.
"""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

#: A block of code, which stays, or an equation that begins a line.
_BLOCK = re.compile(r"^```.*?^```$|^\$\$(.+?)\$\$$", re.MULTILINE | re.DOTALL)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its equations as MathML; called by MkDocs."""
    return _BLOCK.sub(lambda found: found[0] if found[1] is None else _mathml(found[1]), markdown)


def _mathml(latex: str) -> str:
    return f'<div class="equation">{convert(" ".join(latex.split()), display="block")}</div>'
