"""Names from a plant file are text: they run no code, and move or cover no element."""

from __future__ import annotations

from typing import Any

import pytest
from fake_gateway import FakeGateway
from watching import AT_ITS_PLACE, SIZES, VIEWS, Opener

pytestmark = pytest.mark.long  # Chromium is started for each file

MARKUP = '<img src=x onerror="window.hit=1"><script>window.hit=1</script>&amp;'
RIGHT_TO_LEFT = "\u202epots\u202c \u05d0\u05d1\u05d2 \u0645\u0636\u062e\u0629"
LONG = "w" * 300
CYRILLIC = "\u041d\u0430\u0441\u043e\u0441 \u2116 7/\u0430?#%41"
HOSTILE = {"pump-1": MARKUP, "conveyor-2": RIGHT_TO_LEFT, "labeller": LONG, "filler-1": CYRILLIC}


@pytest.fixture
def hostile(gateway: FakeGateway) -> FakeGateway:
    gateway.renamed = HOSTILE
    return gateway


def elements(page: Any) -> list[int]:
    return list(page.evaluate("[document.images.length, document.scripts.length, window.hit ?? 0]"))


@pytest.mark.usefixtures("hostile")
@pytest.mark.parametrize("size", SIZES)
def test_hostile_names_are_shown_as_text_and_break_no_layout(opened: Opener, size: str) -> None:
    page = opened(size=size)
    shown = page.locator("td.name").all_text_contents()
    assert set(HOSTILE.values()) <= set(shown)
    for view in VIEWS:
        page.evaluate("view => { location.hash = view }", view)
        page.wait_for_timeout(300)
        assert elements(page) == [1, 4, 0], view
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0], view
        assert page.evaluate("document.querySelector('main').scrollWidth") <= SIZES[size][0], view
        assert page.evaluate(AT_ITS_PLACE)[0], view


def test_drive_with_a_hostile_name_is_stopped(opened: Opener, hostile: FakeGateway) -> None:
    page = opened()
    for name in HOSTILE.values():
        page.evaluate("name => { location.hash = `#/drives/${encodeURIComponent(name)}` }", name)
        page.locator("#panel h2", has_text=name[:3]).wait_for()
        assert page.locator("#panel h2").text_content() == name
        page.locator("#panel .danger").click()
        assert page.locator("#ask-title").text_content() == f"Stop {name}?"
        assert page.locator("#ask-title bdi").evaluate("e => getComputedStyle(e).unicodeBidi") == "isolate"
        page.locator("#ask .danger").click()
        page.get_by_role("heading", name="The drive is stopped").wait_for()
        page.keyboard.press("Escape")
    assert hostile.posts == [("/api/stop", {"drives": [name]}) for name in HOSTILE.values()]
    assert elements(page)[2] == 0
