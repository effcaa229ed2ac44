"""The pages of the documentation in a real browser: no page is wider than the window."""

import os
from pathlib import Path

import pytest
from view_browser import browser_page

SITE = os.environ.get("GANLANE_SITE")
if SITE is None:
    pytest.skip("no built pages: GANLANE_SITE=FOLDER names them", allow_module_level=True)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with browser_page(tmp_path_factory.mktemp("profile")) as opened:
        opened.size(1280, 900)
        yield opened


@pytest.mark.parametrize(
    "file", sorted(Path(SITE).rglob("index.html")), ids=lambda path: path.parent.name
)
def test_no_page_scrolls_sideways(page, file):
    page.open(file)
    assert page.value("document.documentElement.scrollWidth") <= 1280


def test_the_first_page_has_three_cards_side_by_side_and_equations_need_no_script(page):
    page.open(Path(SITE) / "index.html")
    cards = page.value(
        "[...document.querySelectorAll('.cards li')].map((e) => e.getBoundingClientRect().top)"
    )
    assert len(cards) == 3
    assert len(set(cards)) == 1
    page.open(Path(SITE) / "simulator" / "index.html")
    assert page.value("document.querySelectorAll('.equation math').length") >= 8
    assert "$$" not in page.value("document.querySelector('article').textContent")
