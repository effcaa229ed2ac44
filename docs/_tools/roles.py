"""Docstrings use Sphinx's roles, which Markdown does not know: shown here as code instead.

An extension of Griffe, which reads the docstrings for the site (``mkdocs.yml``).
"""

from __future__ import annotations

import re

from griffe import Extension, Object

#: ``:func:`~ganlane.sim.advance``` with an optional tilde: only the last part of the name is shown.
_ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc):`(~?)([\w.]+)`")
_CODE = re.compile(r"``([^`]+)``")


_ARGUMENTS = re.compile(r"^ *Args:\n(?:.+\n?)+", re.MULTILINE)
_SEVERAL = re.compile(r"^( +)((?:\w+, )+)(\w+): ", re.MULTILINE)


#: A simple table: from one line of equals signs to the last.
_TABLE = re.compile(
    r"^( *)=+ +=[= ]*\n(?:.*\n)*?\1=+ +=[= ]*\n(?:.*\n)*?\1=+ +=[= ]*$", re.MULTILINE
)


def one_by_one(several: re.Match[str]) -> str:
    """``a, b: text`` as two arguments, since Griffe knows only one in a line."""
    indent, names, last = several.groups()
    before = "".join(
        f"{indent}{name}: See `{last}`.\n" for name in names.removesuffix(", ").split(", ")
    )
    return f"{before}{indent}{last}: "


def as_markdown(text: str) -> str:
    """A docstring's text without roles, double backquotes, and the double colon before a block of
    code.
    """
    text = _TABLE.sub(lambda table: f"```text\n{table[0]}\n```", text)
    text = _ROLE.sub(lambda role: f"`{role[2].rpartition('.')[2] if role[1] else role[2]}`", text)
    text = _CODE.sub(r"`\1`", text)
    text = _ARGUMENTS.sub(lambda arguments: _SEVERAL.sub(one_by_one, arguments[0]), text)
    return re.sub(
        r"^ *::$", "", re.sub(r"(?<=\S)::$", ":", text, flags=re.MULTILINE), flags=re.MULTILINE
    )


class Roles(Extension):
    """Rewrites every docstring before it is taken apart."""

    def on_object(self, *, obj: Object, **kwargs: object) -> None:
        """See :class:`griffe.Extension`."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
