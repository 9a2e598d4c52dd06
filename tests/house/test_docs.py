"""Run the code of README and the documentation as printed, and check that their pages are complete.

Each page has its own directory and namespace, in which its blocks run in order. A block whose first line is
`# NAME.toml` or `# NAME.py` is saved under that name. A port /dev/ttyUSBn of a plant file is a simulated line
with the drives of that file.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tables import table, usually

from multidrop import Plant, core
from multidrop.cli import COMMANDS, main
from multidrop.families import MODELS, InnovertIBD
from multidrop.sim import Simulator, Wire, simulated

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
LANGUAGES = {"python", "toml", "sh", "console", "text", "c"}  # text and c blocks are not run
PACKAGES = (
    "multidrop",
    *(
        f"multidrop.{name}"
        for name in ("drive", "families.profiles", "sim", "recording", "capture", "scan", "params", "runs")
    ),
)

# Commands that are not run, by their first words, and the reason.
NOT_RUN = {
    "python3 -m venv": "installs: .ci/run does README's",
    ".venv/bin/pip": "installs",
    ". .venv/bin/activate": "belongs to a shell",
    "mkdir ~/": "makes a directory outside the test's",
    ".venv/bin/pytest": "runs the tests themselves",
    "env/bin/multidrop demo": "takes eight seconds: tools/bare runs it in a bare root",
    ".venv/bin/ruff": "is a step of .ci/run",
    ".ci/run": "runs the tests themselves",
    ".ci/nightly": "takes an hour or more",
    "tools/wheels": "compiles for six machines: many minutes",
    "sudo apt-get": "installs",
    "sudo tools/kernel/build": "builds a Debian: .ci/run does it",
    "python tools/kernel/rig.py": "needs that Debian: tests/system runs its scenarios",
    "MULTIDROP_KERNEL=": "runs the tests themselves",
    "tools/musl": "builds a Python: many minutes",
    "tools/wine": "needs Wine, and downloads a Python for Windows",
    ".venv/bin/python -m bench": "needs rivals and a quiet machine; .ci/nightly runs a benchmark",
    ".venv/bin/python -m sphinx": "has its own test below",
    ".venv/bin/python docs/pictures/make.py": "takes a minute; a test below compares the constant parts",
    "mbpoll": "is another program: tests/gateway/modbus_server/test_masters.py runs it",
    "tshark": "is another program: tests/capture/test_capture.py runs it",
    "multidrop demo --web": "runs until it is stopped: tests/gateway/test_serve.py",
    "multidrop demo": "takes eight seconds: tests/cli and .ci/run run it",
    "multidrop plot demo.arrows": "needs the demo's recording",
    "multidrop report demo.arrows": "needs the demo's recording",
    "multidrop serve --demo": "runs until it is stopped: tests/gateway/test_serve.py",
    "multidrop serve plant.toml": "runs until it is stopped: tests/gateway/test_serve.py",
    "pip install '.[fleet]'": "installs",
    "multidrop fleet demo": "takes half a minute: tests/fleet/test_fleet_command.py runs it",
    "multidrop fleet": "needs servers: tests/fleet/test_drills.py and test_fleet_command.py run it",
    "export MULTIDROP_NATS": "names servers: tests/support/fleet/fleet_drills.py does it",
    "multidrop hub nats://": "needs servers: tests/fleet/test_hub_command.py runs it",
    "multidrop hub tls://": "needs servers: tests/fleet/servers/test_secured_fleet.py runs it",
    "systemctl": "is another program: tests/gateway/test_serve.py sends the same signal",
    "frame=$(curl": "is another program: tests/gateway/live/test_seen_frames.py runs it",
    "start=$(echo": "the same",
    "curl": "is another program: tests/gateway/test_gateway_stops.py sends the same",
    "multidrop doctor": "is about a real adapter: tests/cli/test_doctor.py",
    "multidrop read /dev/ttyUSB0 invt-goodrive": "needs that drive: tests/families/test_responders.py",
    "multidrop sniff /dev/ttyUSB1": "needs a line with another master: tests/cli/test_cli_sniff.py",
}
PROGRAMS = ("openssl", "chmod", "echo")  # other programs that the code blocks of a page may run
# The command with computed figures, which must equal those on the page. Other commands print measured ones.
COMPUTED = "multidrop plan"
STATUS = {"multidrop plan full.toml": 1}  # exit status of commands that must not exit with 0
REPLACED = (  # replacements in code blocks, for short runs on busy machines
    (r"--seconds \d+", "--seconds 1"),
    (r"seconds=\d+", "seconds=0.5"),
    (r'dwell = "\d+ s"', 'dwell = "1 s"'),
    # a longer limit of the time without values, because replies may be late on busy machines
    (r'silence = "\d+ s"', 'silence = "30 s"'),
    (r"--addresses 1-4", "--addresses 1-3 --quick"),
    (r"(multidrop scan /dev/ttyUSB0)", r"\1 --addresses 1-2 --baudrates 9600 --formats 8N1 --quick"),
    (r"(?m)(multidrop poll plant.toml --out run.arrows)$", r"\1 --seconds 1"),
    (r'Bus\("(/dev/ttyUSB\d)"', r'Bus("\1", expiry=30'),  # a longer expiry of writes, for busy machines
)
NEEDED = {  # modules that a page's code block needs, by a text in the block
    "import polars\n": "polars",
    "import pandas\n": "pandas",
    "import duckdb\n": "duckdb",
    "multidrop plot": "matplotlib",
}


class Block(NamedTuple):
    """A fenced block of a page, with the number of its first line."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks, except Sphinx directives."""
    text = page.read_text("utf-8")
    found = re.finditer(r"^( *)```([^\n]*)\n(.*?)^\1```$", text, re.DOTALL | re.MULTILINE)
    return [
        Block(match[2], match[3], text.count("\n", 0, match.start()) + 1)
        for match in found
        if not match[2].startswith("{")
    ]


def prose(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


# Translated pages are not run: other tests check that their code blocks equal those of the English pages.
RUN = [
    page
    for page in PAGES
    if {block.language for block in blocks(page)} & LANGUAGES - {"text", "c"}
    and page.parent.name not in ("ru", "zh")
]


class Session:
    """Runs a page's blocks in the working directory."""

    def __init__(self, stack: ExitStack) -> None:
        self.space: dict[str, Any] = {"__name__": "page"}
        self._stack = stack
        self._wires: dict[str, str] = {}  # links to the simulated lines, by the port on the page

    def run(self, block: Block) -> None:
        """Run a block. Its exceptions pass through."""
        text = block.text
        for pattern, enough in REPLACED:
            text = re.sub(pattern, enough, text)
        saved = re.match(r"# ([\w-]+\.(?:toml|py))\n", text)
        if block.language == "toml":
            assert saved, "a plant file's first line says its name"
            self._save(saved[1], text)
        elif block.language == "python":
            if saved:
                Path(saved[1]).write_text(text)
            source = "\n" * block.line + self._with_ports(text)
            exec(compile(source, "page", "exec", dont_inherit=True), self.space)
        elif block.language in ("sh", "console"):
            self._run_commands(text, has_prompt=block.language == "console")

    def _with_ports(self, text: str) -> str:
        """Return the text with simulated lines in place of real ports."""
        for port in sorted(set(re.findall(r"/dev/ttyUSB\d", text))):
            if port not in self._wires:
                self._play(port, [InnovertIBD(1)])
            text = text.replace(port, self._wires[port])
        return text

    def _save(self, name: str, text: str) -> None:
        """Save a TOML file, and simulate the drives of a plant file."""
        for line in tomllib.loads(text).get("line", ()):
            if line["port"].startswith("/dev/ttyUSB"):
                link = self._wires.setdefault(line["port"], str(Path.cwd() / Path(line["port"]).name))
                text = text.replace(f'"{line["port"]}"', f'"{link}"')
        Path(name).write_text(text)
        if "[[line]]" in text:
            for line in Plant.load(name).lines:
                if line.port in self._wires.values() and not Path(line.port).is_symlink():
                    self._serve(line.port, [polled.drive for polled in line.drives])

    def _play(self, port: str, drives: list[Any]) -> None:
        self._wires[port] = str(Path.cwd() / Path(port).name)
        self._serve(self._wires[port], drives)

    def _serve(self, link: str, drives: list[Any]) -> None:
        wire = Wire([simulated(drive) for drive in drives], port=link, unpaced=True)
        # faster than real time, so that motors stop soon
        self._stack.enter_context(Simulator([wire], speed=10))

    def _run_commands(self, text: str, *, has_prompt: bool) -> None:
        commands: list[tuple[str, list[str]]] = []
        for line in text.replace("\\\n", "").splitlines():
            if line.startswith("$ ") or not has_prompt:
                commands.append((line.removeprefix("$ "), []))
            elif commands:
                commands[-1][1].append(line)
        for command, shown in commands:
            if command and not any(command.startswith(begin) for begin in NOT_RUN):
                form = spaced if command.startswith(COMPUTED) else shape
                compare(shown, self._run_command(command), form)

    def _run_command(self, command: str) -> str:
        """Run a command, and return what it prints; with `>> FILE`, add the output to the file."""
        command, _, added_to = command.partition(" >> ")
        words = shlex.split(self._with_ports(command), comments=True)
        if words[0] in PROGRAMS:
            printed = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        else:
            assert words[0] == "multidrop", f"{command!r} is neither run nor listed in NOT_RUN"
            if words[1] == "simulate":
                return self._simulate(words[1:])
            output, errors = StringIO(), StringIO()
            with redirect_stdout(output), redirect_stderr(errors if added_to else output):
                status = main(words[1:])
            printed = output.getvalue()
            assert status == STATUS.get(command, 0), printed + errors.getvalue()
        if added_to:
            with Path(added_to).open("a") as file:
                file.write(printed)
        return printed

    def _simulate(self, words: list[str]) -> str:
        """Start the simulator, which runs until the page ends; return its first line."""
        program = "import sys; from multidrop.cli import main; sys.exit(main())"
        command = [sys.executable, "-c", program, *words, "--unpaced"]
        process = self._stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        self._stack.callback(process.terminate)
        assert process.stdout is not None
        return process.stdout.readline()


def compare(shown: list[str], printed: str, form: Callable[[str], str]) -> None:
    """Fail unless every line that a page shows was printed, compared after `form`.

    `…` on the page replaces omitted lines.
    """
    left = [form(line) for line in printed.splitlines()]
    for line in filter(None, map(form, shown)):
        if line != "…":
            assert line in left, f"{line!r} was not printed, but\n{printed}"


def spaced(line: str) -> str:
    """Return the line with single spaces."""
    return re.sub(r"\s+", " ", line).strip()


def shape(line: str) -> str:
    """Return the line with 0 for each number, and without time units, because measured figures vary."""
    plural = re.sub(r"\b1 miss\b", "1 misses", line)
    return spaced(re.sub(r"\d+(\.\d+)?( (ms|us))?", "0", plural))


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with ExitStack() as stack:
        yield Session(stack)


@pytest.mark.usefixtures("_turns_awaited")  # writes have no time limit, because a busy machine delays them
@pytest.mark.parametrize("page", usually(*RUN), ids=named)
def test_the_code_blocks_of_a_page_run_as_printed(page: Path, session: Session) -> None:
    text = page.read_text("utf-8")
    for needs, module in NEEDED.items():
        if needs in text and find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    for block in blocks(page):
        try:
            session.run(block)
        except Exception as failure:
            raise AssertionError(f"{named(page)}, line {block.line}: {failure}") from failure


def test_every_code_block_names_a_known_language() -> None:
    found = {(named(page), block.line, block.language) for page in PAGES for block in blocks(page)}
    assert [each for each in found if each[2] not in LANGUAGES] == []


def test_each_command_excluded_from_these_tests_is_in_the_documentation() -> None:
    text = "\n".join(block.text for page in PAGES for block in blocks(page))
    assert [begin for begin in NOT_RUN if begin not in text] == []


# ---- inline statements ----

PLACEHOLDERS = {
    "PORT": "port",
    "MODEL": "yd1000",
    "ADDRESS": "1",
    "REGISTER": "control",
    "COMMAND": "poll",
    "FILE": "plant.toml",
    "HZ": "10",
    "DRIVE": "pump-1",
}
MENTIONED = sorted(
    {
        re.sub(r"\s+", " ", words)
        for page in PAGES
        for words in re.findall(r"`multidrop\s([^`]+)`", prose(page))
        if "..." not in words
    }
)


@table("mentioned", MENTIONED)
def test_commands_in_the_docs_are_accepted_by_the_argument_parser(
    mentioned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [PLACEHOLDERS.get(word, word) for word in shlex.split(mentioned)]
    if words[0].startswith("--"):
        return
    assert words[0] in COMMANDS
    module = importlib.import_module(f"multidrop.cli.{COMMANDS[words[0]][0]}")
    arguments = words[1:]
    if hasattr(module, "ACTIONS") and arguments:
        name = module.ACTIONS[arguments.pop(0)][0]
        module = importlib.import_module(f"{module.__name__}.{name}") if name else module
    is_typed_so = arguments and not arguments[0].startswith("--")
    if is_typed_so:
        monkeypatch.setattr(module, "run", lambda arguments: 0)
        assert main(words) == 0


def test_every_link_on_a_page_has_an_existing_target() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", prose(page)):
            is_there = target.startswith("https://") or (page.parent / target).exists()
            assert is_there, f"{named(page)}: {target}"


def test_no_line_is_too_long() -> None:
    lines = [(named(page), line) for page in PAGES for line in page.read_text("utf-8").splitlines()]
    assert [(page, line) for page, line in lines if len(line) > 110] == []


# ---- completeness of the pages ----


def page_table(page: str, heading: str = "") -> dict[str, str]:
    """Return the rows of the first table after a heading: first column to the rest of the row."""
    text = (DOCS / page).read_text("utf-8")
    text = text[text.index(heading) :]
    rows = re.search(r"^\|.*?(?=\n\n|\Z)", text, re.DOTALL | re.MULTILINE)
    assert rows
    return {
        name: rest
        for line in rows[0].splitlines()[2:]
        for first, rest in [line.strip("| ").split(" | ", 1)]
        for name in re.findall(r"`([^`]+)`", first)
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_in_the_reference(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    public = importlib.import_module("public_names").public
    with_names = importlib.import_module("plain_pages").with_names
    pages = "\n".join(with_names(page.read_text("utf-8")) for page in (DOCS / "reference").glob("*.md"))
    given = re.findall(
        rf"^```{{public-names}} {re.escape(package)}\n(.*?)^```", pages, re.DOTALL | re.MULTILINE
    )
    assert any(":rest:" in names for names in given)
    names = " ".join(given).replace(":rest:", "").split()
    assert set(names) <= set(public(importlib.import_module(package)))


@pytest.mark.parametrize("page", ["index.md", "reference/api.md"])
def test_the_index_and_api_pages_are_plain_markdown(page: str) -> None:
    """A code host shows directives and definition lists as raw text."""
    text = (DOCS / page).read_text("utf-8")
    assert re.findall(r"^```\{.*|^: .*|^:::.*", text, re.MULTILINE) == []


def test_every_page_is_in_the_table_of_contents() -> None:
    text = (DOCS / "index.md").read_text("utf-8")
    linked = set(re.findall(r"\(([\w/-]+\.md)\)", text))
    # these pages are parts of other pages
    included = {"explanation/speed-table.md", "reference/line-states.md"}
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md"}
    assert {page for page in pages - included - linked if "/walks/" not in page} == set()


def test_every_status_of_a_row_is_in_the_reference() -> None:
    known = {status for status in core.STATUSES if status and not status.startswith("exception")}
    exceptions, of_channels = {"exception 01", "exception FF"}, {"input too old"}
    assert known == set(page_table("reference/statuses.md")) - exceptions - of_channels


def test_every_column_of_a_recording_is_in_the_reference() -> None:
    from multidrop.polling.batch import schema

    assert [child.name for child in schema().children] == list(page_table("reference/recording-format.md"))


def test_every_key_of_a_plant_file_is_in_the_reference() -> None:
    from multidrop.plant import loader

    page = "reference/plant-file.md"
    assert list(page_table(page, "## `[[line]]`")) == list(loader.LINE_KEYS)
    assert set(page_table(page, "## `[[line.drive]]`")) == set(loader.DRIVE_KEYS)
    assert list(page_table(page, "## An entry of `poll`")) == list(loader.POLL_KEYS)


def test_every_family_is_in_the_reference() -> None:
    text = (DOCS / "reference" / "families.md").read_text("utf-8")
    assert re.findall(r"^- `([\w-]+)` ", text, re.MULTILINE) == list(MODELS)


def test_no_header_of_a_table_is_a_copied_row() -> None:
    """Find table headers that were copied from a row, which mislabel the columns below."""
    for page in PAGES:
        text = page.read_text("utf-8")
        heads = re.findall(r"^(\|.*\|)\n\|-", text, re.MULTILINE)
        rows = Counter(re.findall(r"^\|.*\|$", text, re.MULTILINE))
        assert [head for head in heads if rows[head] > heads.count(head)] == [], page


def test_every_extra_is_in_the_reference() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    text = (DOCS / "reference" / "cli.md").read_text("utf-8")
    rows = text.partition("| for | install |")[2].partition("\n\n")[0].splitlines()[2:]
    given = {word for row in rows for word in re.findall(r"`([\w-]+)`", row.split("|")[2])}
    assert given == set(extras) - {"bench", "docs", "test"}


def test_the_speed_table_equals_that_of_the_readme() -> None:
    speed = (DOCS / "explanation" / "speed-table.md").read_text("utf-8")
    assert speed.strip() in (ROOT / "README.md").read_text("utf-8")


def test_the_timing_diagrams_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "pictures"))
    diagrams = importlib.import_module("diagrams")
    for name in diagrams.DIAGRAMS:
        assert (DOCS / "pictures" / f"{name}.svg").read_text("utf-8") == diagrams.draw(name)


def test_the_text_of_a_timing_diagram_fits_its_box(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "pictures"))
    diagrams = importlib.import_module("diagrams")
    for name in diagrams.DIAGRAMS:
        boxes = re.findall(r"<rect x=.*? width='([\d.]+)'.*?<text[^>]*>([^<]*)<", diagrams.draw(name))
        assert boxes
        letter = 7.0  # px, width of a letter in a wide font such as DejaVu Sans
        assert [text for width, text in boxes if len(text) * letter > float(width)] == []


@pytest.mark.uncounted
@pytest.mark.long
def test_sphinx_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    options = ("-q", "-W", "--keep-going", "-b", "html")
    command = [sys.executable, "-m", "sphinx", *options, str(DOCS), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# ---- compare the Russian and Chinese pages with the English pages that they translate ----


TRANSLATED = ("ru", "zh")
README = (ROOT / "README.md").read_text("utf-8")
ENGLISH = {
    "before-you-connect-a-motor.md": (ROOT / "docs" / "before-you-connect-a-motor.md").read_text("utf-8"),
    "quick-start.md": README.partition("\n## Families\n")[0],
}
TRANSLATIONS = [(language, page) for language in TRANSLATED for page in ENGLISH]
of_each_page = pytest.mark.parametrize(("language", "page"), TRANSLATIONS)
PARTS = re.compile(r"^(#+|-|\d+\.) |^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def translation(language: str, page: str) -> str:
    return (ROOT / "docs" / language / page).read_text("utf-8")


def sections(text: str) -> list[str]:
    return re.split(
        r"^## ", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL), flags=re.MULTILINE
    )


def codes(section: str) -> set[str]:
    """Return the words between backticks, and the figures of a section."""
    plain = re.sub(r"\]\([^)]*\)", "]", section)
    found = re.findall(r"`([^`]+)`|(?<![\w.])(\d+(?:\.\d+)?)(?!\w|\.\d)", plain)
    return {" ".join((code or figure).split()) for code, figure in found}


def revision(text: str) -> str:
    """Return a short digest of a page; line breaks do not change it."""
    return hashlib.sha256(" ".join(text.split()).encode()).hexdigest()[:8]


@of_each_page
def test_each_translation_has_the_structure_of_the_english_page(language: str, page: str) -> None:
    assert PARTS.findall(translation(language, page)) == PARTS.findall(ENGLISH[page])


@of_each_page
def test_each_translated_section_has_the_names_and_figures_of_the_english_one(
    language: str, page: str
) -> None:
    pairs = zip(sections(translation(language, page)), sections(ENGLISH[page]), strict=True)
    assert [codes(own) ^ codes(other) for own, other in pairs if codes(own) != codes(other)] == []


@of_each_page
def test_each_translation_names_the_current_revision_of_the_english_page(language: str, page: str) -> None:
    assert f"<!-- translates revision {revision(ENGLISH[page])} -->" in translation(language, page)


@pytest.mark.parametrize("page", ["README.md", "docs/before-you-connect-a-motor.md"])
def test_each_english_page_links_its_translations_at_its_top(page: str) -> None:
    top = (ROOT / page).read_text("utf-8").partition("\n\n##")[0]
    assert all(re.search(rf"\]\((docs/)?{language}/", top) for language in TRANSLATED)
