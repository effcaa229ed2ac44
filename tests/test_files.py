"""A document with a part between two markers: that part is rewritten, the rest is kept, anything else is refused."""

from __future__ import annotations

import pytest

from ganlane.errors import UserError
from ganlane.files import split_at_markers, write_between_markers

BEGIN, END = "<!-- begin -->", "<!-- end -->"


def test_what_stands_between_the_markers_is_rewritten_and_the_rest_is_kept(tmp_path):
    document = tmp_path / "page.md"
    document.write_text(f"# Title\n{BEGIN}{END} tail é\n", encoding="utf-8")
    for content in ("one", "two\nlines"):
        write_between_markers(document, BEGIN, END, content)
        assert document.read_text(encoding="utf-8") == f"# Title\n{BEGIN}\n{content}\n{END} tail é\n"
    assert split_at_markers(document, BEGIN, END) == (f"# Title\n{BEGIN}", f"{END} tail é\n")


@pytest.mark.parametrize("text", ["", BEGIN, END, f"{END}{BEGIN}", f"{BEGIN}{END}{END}", f"{BEGIN}{BEGIN}{END}"])
def test_a_document_without_both_markers_once_and_in_order_is_refused_and_kept(tmp_path, text):
    document = tmp_path / "page.md"
    document.write_text(text)
    with pytest.raises(UserError, match=r"page\.md: expected the lines <!-- begin --> and <!-- end -->"):
        write_between_markers(document, BEGIN, END, "new")
    assert document.read_text() == text


def test_a_missing_document_is_refused_and_not_made(tmp_path):
    document = tmp_path / "gone.md"
    with pytest.raises(UserError, match=r"gone\.md: no such file"):
        write_between_markers(document, BEGIN, END, "new")
    assert not document.exists()
