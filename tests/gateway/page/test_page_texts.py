"""Files of the web page: texts are translated, scripts make no markup from texts, and no file is missing."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any, NamedTuple

import fake_plant
import pytest
from fake_gateway import FakeGateway
from watching import Opener, aborting, until, until_met, until_settled, violations

from multidrop.control import CommandOutcome
from multidrop.control.outcome import Effect, Seen
from multidrop.core.exchange import Status
from multidrop.drive.register import Access
from multidrop.drive.verbs import LISTED_VERBS
from multidrop.fleet.lines.member import MemberState
from multidrop.gateway.http.files import PAGE, read_files
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live import alarms, hub
from multidrop.gateway.live.alarms import KINDS
from multidrop.history.units import RAW

LANGUAGES = {"ru", "zh"}
CATALOGUE = (PAGE / "texts.toml").read_text("utf-8")
TEXTS: dict[str, dict[str, str]] = tomllib.loads(CATALOGUE)
OWN_PART, GATEWAY_PART = map(tomllib.loads, re.split(r"^# ====.*$", CATALOGUE, flags=re.MULTILINE))
# scripts by path, relative to the page's folder
SCRIPTS = {
    name: file.body.decode()
    for name, file in read_files(PAGE).items()
    if name.endswith(".js") and not name.startswith("vendor/")
}
NAMES = {"UTC", "CSV", "Parquet", "Enter", "Esc", "Shift S", "multidrop", "English", "Русский", "中文"}
OTHERS = {"danger stop", "Etc/UTC", "px system-ui, sans-serif", "11px system-ui, DejaVu Sans, sans-serif"}


def lack_of(register: str, polled: list[str]) -> str:
    """Return the gateway's text for "state unknown, because this register has no value"."""
    watched: Any = SimpleNamespace(reader=SimpleNamespace(has_state=True, lacks=register), cells=polled)
    return hub._lack(watched)


GATEWAY_WORDS = {
    *(str(status) for status in Status),
    *(one.value for kind in (CommandOutcome, Effect, Seen, MemberState, Access) for one in kind),
    *(verb.replace("_", " ") for verb in LISTED_VERBS),
    *(right.name.lower() for right in Right),
    *(alarms.UNCALLED, hub.UNNAMED, hub.NOT_ASKED, hub.INCOMPLETE, RAW),
    *(lack_of("{name}", cells) for cells in ([], ["{name}"])),
}
# names of functions whose first argument is a key of the catalogue of texts
TRANSLATING = {"t", "pieces", "said"}
# Functions of the page that show their arguments to the user, and the index of the first shown argument.
SHOWING = {"make": 2, "put": 1, "fill": 1, "named": 0, "say": 0, "Error": 0, "Refused": 1}
SHOWN = {"title", "aria-label", "placeholder", "alt", "data-head"}  # HTML attributes that the user can read
TECHNICAL = {"class", "find", "closest", "matches", "matchMedia", "querySelector", "querySelectorAll"}

TOKEN = re.compile(
    r"""(?P<comment>//[^\n]*)
      | (?P<regex>/(?![/*\s=])(?:\\.|\[[^\]]*\]|[^/\n])+/[a-z]*(?=[.,)]))
      | (?P<key>(?<=[{,\s])(?:"[\w-]+"|\w+)(?=:\s))
      | (?P<text>"(?:\\.|[^"\\])*")
      | (?P<template>`)
      | (?P<call>[\w$]+(?=\())
      | (?P<open>[(\[{])
      | (?P<close>[)\]}])
      | (?P<comma>,)
      | (?P<other>[\w$]+|\s+|.)""",
    re.DOTALL | re.VERBOSE,
)
TEMPLATE = re.compile(r"((?:\\.|[^`$\\]|\$(?!\{))*)(`|\$\{)", re.DOTALL)
WORD = re.compile(r"[^\W\d_]{2,}")
SENTENCE = re.compile(r"[A-Z][a-z]|[^\W\d_] [^\W\d_]")
ASSIGNED = re.compile(r"\.(?:title|textContent|innerText|placeholder|ariaLabel) = [\"`]\w")
COMPARED = re.compile(r"([!=]==) \"[^\"]*\"")
PLACEHOLDER = re.compile(r"\{\w+\}")


class Bracket(NamedTuple):
    """An open bracket in a script: the called function, the argument's number, and the key in an object."""

    call: str = ""
    argument: int = 0
    key: str = ""


class Literal(NamedTuple):
    """A string in a script, with the brackets around it from outside to inside."""

    text: str
    around: tuple[Bracket, ...]

    @property
    def is_key(self) -> bool:
        """True if the string is a key of the catalogue of texts."""
        return self.around[-1].call in TRANSLATING and self.around[-1].argument == 0

    @property
    def is_shown(self) -> bool:
        """True if the user sees the string at its place, or if it looks like a text."""
        inner = next((one for one in reversed(self.around) if one.call or one.key), Bracket())
        if inner.call in TECHNICAL or inner.key in TECHNICAL:
            return False
        first = SHOWING.get(inner.call)
        is_at_shown_place = inner.key in SHOWN or (first is not None and inner.argument >= first)
        return bool((WORD if is_at_shown_place else SENTENCE).search(self.text))


def literals(script: str) -> Iterator[Literal]:
    """Yield the strings of a script, including the parts of templates between their values."""
    script = COMPARED.sub(r"\1 0", re.sub(r'"\s*\+\s*"', "", script))
    brackets, call, at = [Bracket()], "", 0
    while at < len(script):
        if brackets[-1].call == "`":
            found = TEMPLATE.match(script, at)
            assert found is not None
            yield Literal(found[1], (*brackets[:-1],))
            brackets[-1:] = [brackets[-1], Bracket()] if found[2] == "${" else []
        else:
            found = TOKEN.match(script, at)
            assert found is not None
            kind, last = found.lastgroup, brackets[-1]
            if kind == "text":
                yield Literal(found[0][1:-1], (*brackets,))
            elif kind in ("open", "template"):
                brackets.append(Bracket("`" if kind == "template" else call))
            elif kind == "close":
                brackets.pop()
            elif kind == "comma":
                brackets[-1] = last._replace(argument=last.argument + 1, key="")
            elif kind == "key":
                brackets[-1] = last._replace(key=found[0].strip('"'))
            call = found[0] if kind == "call" else ""
        at = found.end()


def strangers(script: str) -> list[str]:
    """Return the texts in a script that the user sees and that are not in the catalogue."""
    found = [one.text for one in literals(script) if not one.is_key and one.is_shown]
    return [text for text in found if text not in NAMES | OTHERS] + ASSIGNED.findall(script)


class HtmlTexts(HTMLParser):
    """Collects the readable attributes and texts of index.html, except those in `noscript`."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: set[str] = set()
        self._is_noscript = False
        self.feed((PAGE / "index.html").read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._is_noscript |= tag == "noscript"
        self.texts |= {value for name, value in attrs if name in SHOWN and value}

    def handle_endtag(self, tag: str) -> None:
        self._is_noscript &= tag != "noscript"

    def handle_data(self, data: str) -> None:
        if WORD.search(data) and not self._is_noscript:
            self.texts.add(data.strip())


# texts that the page's own scripts and HTML take from the catalogue
PAGE_TEXTS = {one.text for script in SCRIPTS.values() for one in literals(script) if one.is_key}
PAGE_TEXTS |= HtmlTexts().texts


@pytest.mark.parametrize("script", SCRIPTS)
def test_each_visible_text_of_a_script_has_a_translation(script: str) -> None:
    found = literals(SCRIPTS[script])
    assert strangers(SCRIPTS[script]) == []
    assert {one.text for one in found if one.is_key} - TEXTS.keys() == set()


@pytest.mark.parametrize(
    "script",
    [
        'make("p", {}, "hello")',
        'make("p", {}, isBad ? "hello" : null)',
        'make("input", { placeholder: "hello", class: "a b" })',
        "put(element, `${n} drives`)",
        'const TITLE = "Hello";',
        'const why = { a: ["two words", 1] };',
        'element.title = "hello"',
        'throw new Error("hello")',
        't("Stop {what}", { what: "a drive" })',
    ],
)
def test_the_check_of_translations_finds_an_untranslated_text(script: str) -> None:
    assert strangers(script) != []


def test_each_text_of_the_html_has_a_translation() -> None:
    assert HtmlTexts().texts - TEXTS.keys() - NAMES == set()


def test_the_css_contains_no_texts() -> None:
    styles = "".join(path.read_text("utf-8") for path in PAGE.glob("style/*.css"))
    assert [text for text in re.findall(r"content:([^;]*);", styles) if re.search(r'"[^"]*\w', text)] == []


def test_each_text_has_all_languages_with_the_same_placeholders() -> None:
    for english, translations in TEXTS.items():
        assert translations.keys() == LANGUAGES, english
        for language, text in translations.items():
            expected = sorted(PLACEHOLDER.findall(english))
            assert sorted(PLACEHOLDER.findall(text)) == expected, (english, language)
            assert text.strip() == text != "", (english, language)


def test_each_fixed_text_of_the_gateway_has_a_translation() -> None:
    assert GATEWAY_WORDS - TEXTS.keys() == set()


def test_the_translations_contain_no_unused_text() -> None:
    assert OWN_PART.keys() - PAGE_TEXTS == set()
    sources = "".join(
        path.read_text("utf-8")
        for room in ("control", "drive", "families", "gateway/live")
        for path in (PAGE.parents[1] / room).rglob("*.*")
        if path.suffix in (".py", ".toml")
    )
    others = GATEWAY_PART.keys() - GATEWAY_WORDS
    assert [text for text in others if PLACEHOLDER.split(text)[0] not in sources] == []


def test_each_language_of_the_page_is_served_as_one_file() -> None:
    files = read_files(PAGE)
    assert {name for name in files if name.startswith("texts.")} == {
        "texts.js",
        *(f"texts.{language}.json" for language in LANGUAGES),
    }
    assert json.loads(files["texts.zh.json"].body)["Stop all"] == TEXTS["Stop all"]["zh"]
    assert 'TRANSLATED = ["ru", "zh"]' in SCRIPTS["boot.js"]
    assert re.findall(r'  \["(\w+)", "\w+"\],', SCRIPTS["texts.js"]) == ["en", "ru", "zh"]


# ---- the page's languages: their choice, and every view in each language on a narrow screen ----


VIEWS = ("#/drives", "#/drives/pump-1", "#/trends", "#/faults", "#/lines", "#/log", "#/fleet")
NARROW = {"width": 360, "height": 780}
STOP_ALL = {"en": "Stop all", **TEXTS["Stop all"]}
LIVE = {"en": "live", **TEXTS["live"]}
# Return two lists. First: visible texts and attributes, without the plant's own names. Second: elements that
# are too wide, and words that are broken into two lines.
READ = """() => {
  const attributes = ["title", "aria-label", "placeholder", "data-head"];
  const visible = element => element.checkVisibility({ visibilityProperty: true });
  const texts = [], nodes = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (nodes.nextNode()) {
    const { parentElement: parent, data } = nodes.currentNode;
    if (visible(parent) && !parent.closest("bdi, kbd, noscript")) texts.push(data);
  }
  for (const name of attributes)
    for (const element of document.querySelectorAll(`[${name}]`))
      if (visible(element)) texts.push(element.getAttribute(name));
  const wide = [...document.querySelectorAll("html, body, main, nav, dialog, button, .card")].filter(
    element => visible(element) && element.scrollWidth > element.clientWidth + 1,
  );
  const broken = [];
  for (const element of document.querySelectorAll("td.name a, .audit .words")) {
    const nodes = document.createTreeWalker(element, NodeFilter.SHOW_TEXT);
    while (nodes.nextNode())
      for (const { 0: word, index } of nodes.currentNode.data.matchAll(/[\\p{L}\\d]+/gu)) {
        const range = new Range();
        range.setStart(nodes.currentNode, index);
        range.setEnd(nodes.currentNode, index + word.length);
        if (visible(element) && range.getClientRects().length > 1) broken.push(`broken word: ${word}`);
      }
  }
  const said = wide.map(element => `too wide: ${element.tagName} ${element.textContent}`);
  return [texts, [...said, ...broken]];
}"""


def english_in(texts: list[str]) -> set[str]:
    """Return the English texts of the page, of four letters or more, that occur in these texts."""
    joined = "\n".join(texts)
    pieces = {piece.strip(" .,:;()") for text in PAGE_TEXTS - NAMES for piece in PLACEHOLDER.split(text)}
    pieces.remove("table")  # references to manuals, such as "table 9-2", are always in English
    return {
        piece
        for piece in pieces
        if re.search(r"[a-zA-Z]{4}", piece) and re.search(rf"(?<![\w-]){re.escape(piece)}(?![\w-])", joined)
    }


@pytest.mark.long
@pytest.mark.parametrize("language", ["ru", "zh"])
def test_each_view_is_translated_and_fits_a_narrow_screen(opened: Opener, axe: str, language: str) -> None:
    page = opened(live=False, locale=language)
    page.set_viewport_size(NARROW)
    until(page, f"document.querySelector('#link').textContent === '{LIVE[language]}'")
    page.evaluate(axe)
    found: dict[str, Any] = {}

    def read(view: str) -> None:
        until_settled(page)
        texts, wide = page.evaluate(READ)
        assert len(texts) > 10, view
        # The colours are the same in all languages, so their contrast is tested only once.
        found[view] = [*english_in(texts), *wide, *violations(page, "color-contrast")]

    for view in VIEWS:
        page.evaluate("view => { location.hash = view }", view)
        read(view)
    page.locator("#more").click()
    read("settings")
    page.keyboard.press("Escape")
    page.locator("#stopall").click()
    read("question about a stop")
    page.locator("#ask .danger").click()
    stopped = TEXTS["All {n} drives are stopped"][language].replace("{n}", "10")
    page.get_by_role("heading", name=stopped).wait_for()
    read("outcome of a stop")
    assert {view: problems for view, problems in found.items() if problems} == {}


@pytest.mark.long
@pytest.mark.parametrize(("locale", "language"), [("ru-RU", "ru"), ("zh-TW", "zh"), ("de-DE", "en")])
def test_the_page_has_the_language_of_the_browser(opened: Opener, locale: str, language: str) -> None:
    page = opened(live=False, locale=locale)
    page.locator("#link").get_by_text(LIVE[language], exact=True).wait_for()
    assert page.locator("html").get_attribute("lang") == language
    assert page.locator("#stopall").inner_text() == STOP_ALL[language]


@pytest.mark.long
def test_the_language_chosen_on_the_page_overrides_the_browser_language(opened: Opener) -> None:
    page = opened(live=False, locale="ru-RU")
    page.locator("#link").get_by_text(LIVE["ru"], exact=True).wait_for()
    for title, language in (("中文", "zh"), ("English", "en")):
        page.locator("#more").click()
        with page.expect_request(lambda request, one=language: request.url.endswith(f"api/plant?lang={one}")):
            page.get_by_label(title).click()
        page.locator("#link").get_by_text(LIVE[language], exact=True).wait_for()
        other = page.context.new_page()
        other.goto(page.url)
        other.locator("#link").get_by_text(LIVE[language], exact=True).wait_for()
        assert other.locator("html").get_attribute("lang") == language
        other.close()


@pytest.mark.long
def test_the_page_shows_the_register_titles_that_the_gateway_sends(
    opened: Opener, gateway: FakeGateway
) -> None:
    first = fake_plant.plant({})["lines"][0]
    titled = [one | {"title": f"«{one['name']}»"} for one in first["drives"][0]["registers"]]
    gateway.plant_changes = {"lines": [first | {"drives": [first["drives"][0] | {"registers": titled}]}]}
    page = opened("#/drives/pump-1")
    for place, name in (("th", "output_frequency"), ("option", "dc_bus_voltage")):
        page.locator(f"#panel {place}", has_text=f"«{name}»").first.wait_for(state="attached")
    assert page.get_by_role("button", name="Change «frequency_setpoint»").is_visible()


@pytest.mark.long
def test_the_page_is_english_if_its_translations_cannot_be_loaded(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened(live=False, locale="ru-RU", prepare=aborting("**/page/texts.ru.json"))
    page.locator("#link").get_by_text("live", exact=True).wait_for()
    assert page.locator("html").get_attribute("lang") == "en"
    page.get_by_role("button", name="Stop all", exact=True).click()
    page.get_by_role("button", name="Stop all 10 drives").click()
    until_met(page, lambda: gateway.posts == [("/api/stop", {"drives": None})])


@pytest.mark.long
def test_composed_texts_of_the_gateway_are_translated_piece_by_piece(opened: Opener) -> None:
    page = opened(live=False, locale="zh-CN")
    said = "texts => import('/page/texts.js').then(({ said }) => texts.map(said))"
    expected = {
        "no reply": "无应答",
        "unconfirmed: not sent: expired": f"未确认: {TEXTS['not sent: expired']['zh']}",
        "stopped: seen to stand after 1.2 s": "已停止: 1.2 秒后电机停稳",
        "undervoltage (UV)": "欠电压 (UV)",
        "terminals is not polled": "寄存器 terminals 未轮询",
        "raw count": "原始值",
        "constructor": "constructor",
    }
    assert page.evaluate(said, [*expected]) == [*expected.values()]


# ---- all files of the page ----

FILES = {path.relative_to(PAGE).as_posix(): path for path in sorted(PAGE.rglob("*")) if path.is_file()}
OURS = [
    path
    for name, path in FILES.items()
    if path.suffix in (".js", ".css", ".html") and not name.startswith("vendor/")
]
MARKUP = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|createContextualFragment|DOMParser|srcdoc"
CODE = r"\beval\(|new Function|javascript:|setAttribute\(\s*[\"']style|cssText"


def test_page_scripts_use_no_function_that_makes_markup_or_code_from_text() -> None:
    for name, script in SCRIPTS.items():
        assert re.findall(f"{MARKUP}|{CODE}", script) == [], name


def test_the_html_has_no_inline_style_script_or_event_handler() -> None:
    html = (PAGE / "index.html").read_text("utf-8")
    assert re.findall(r"\sstyle\s*=|<style|\son\w+\s*=|<script(?![^>]*\ssrc=)|https?://|data:", html) == []


def test_page_files_are_short_and_start_with_a_comment() -> None:
    for path in OURS:
        lines = path.read_text("utf-8").splitlines()
        assert len(lines) <= 600, path.name
        assert max(map(len, lines)) <= 110 or path.suffix == ".html", path.name
        assert path.suffix == ".html" or re.match(r"// [A-Z]|/\* [A-Z]", lines[0]), path.name


def test_the_web_page_refers_to_all_its_files_and_to_no_others() -> None:
    named = set(re.findall(r'"page/([\w./-]+)"', (PAGE / "index.html").read_text("utf-8")))
    for name, script in SCRIPTS.items():
        imports = re.findall(r'from "(\.[\w./-]+)"', script)
        folder = (PAGE / name).parent
        named |= {(folder / path).resolve().relative_to(PAGE.resolve()).as_posix() for path in imports}
    there = FILES.keys()
    # files for Prometheus and Grafana, which the page does not use
    served = {"prometheus/alerts.yml", "prometheus/dashboard.json"}
    assert there - named == {"index.html", "texts.toml", "vendor/uPlot-LICENSE", *served}
    assert named - there == set()


def test_each_kind_of_alarm_has_a_shape_a_colour_and_a_word() -> None:
    index, strip, lanes, table, bars, words = (
        (PAGE / name).read_text("utf-8")
        for name in (
            "index.html",
            "style/top.css",
            "style/plots.css",
            "style/views.css",
            "views/trends/lane.js",
            "ui/values.js",
        )
    )
    for kind in KINDS:
        assert f'id="glyph-{kind}"' in index
        assert f".strip .{kind}" in strip
        assert f".lane .{kind}" in lanes
        assert f".faults tr.{kind} .kind" in table
        assert f'"{kind}"' in bars
        assert f"\n  {kind}: " in words[words.index("ALARMS") :]


def test_the_included_plot_library_has_its_licence() -> None:
    licence = (PAGE / "vendor" / "uPlot-LICENSE").read_text("utf-8")
    script = (PAGE / "vendor" / "uPlot.iife.min.js").read_text("utf-8")
    assert "The MIT License" in licence
    assert "Leon Sorokin" in licence
    assert "(v1.6.32)" in script[:80]
