"""Files of the web page: scripts make no markup from texts, the CSP is kept, and no file is missing."""

from __future__ import annotations

import re

from fake_gateway import PAGE

from multidrop.gateway.live.alarms import KINDS

FILES = {path.relative_to(PAGE).as_posix(): path for path in sorted(PAGE.rglob("*")) if path.is_file()}
OURS = [
    path
    for name, path in FILES.items()
    if path.suffix in (".js", ".css", ".html") and not name.startswith("vendor/")
]
SCRIPTS = [path for path in OURS if path.suffix == ".js"]
MARKUP = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|createContextualFragment|DOMParser|srcdoc"
CODE = r"\beval\(|new Function|javascript:|setAttribute\(\s*[\"']style|cssText"


def test_page_scripts_use_no_function_that_makes_markup_or_code_from_text() -> None:
    for path in SCRIPTS:
        assert re.findall(f"{MARKUP}|{CODE}", path.read_text("utf-8")) == [], path.name


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
    for script in SCRIPTS:
        imports = re.findall(r'from "(\.[\w./-]+)"', script.read_text("utf-8"))
        named |= {(script.parent / path).resolve().relative_to(PAGE.resolve()).as_posix() for path in imports}
    there = FILES.keys()
    # files for Prometheus and Grafana, which the page does not use
    served = {"prometheus/alerts.yml", "prometheus/dashboard.json"}
    assert there - named == {"index.html", "texts.toml", "vendor/uPlot-LICENSE", *served}
    assert named - there == set()


def test_each_kind_of_alarm_has_its_shape_colour_word_and_trend_bar() -> None:
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


def test_vendored_plot_library_has_its_licence() -> None:
    licence = (PAGE / "vendor" / "uPlot-LICENSE").read_text("utf-8")
    script = (PAGE / "vendor" / "uPlot.iife.min.js").read_text("utf-8")
    assert "The MIT License" in licence
    assert "Leon Sorokin" in licence
    assert "(v1.6.32)" in script[:80]
