"""Check README, tests/README.md, the examples and the container files: they agree with the sources.

Commands, options, files, tests, names and ports exist. test_docs.py runs the code of all pages.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import patient
import pytest
import yaml
from lines import PATIENCE
from nats_clusters import server_program
from sources import files, run_time_imports
from tables import table

from multidrop.cli import COMMANDS, main
from multidrop.control import read_audit
from multidrop.families import MODELS
from multidrop.gateway.parts import PARTS
from multidrop.recording import open_recording

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")

SETTING_UP = [
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/multidrop demo",
    "python3 -m venv .venv && .venv/bin/pip install '.[test]' && .venv/bin/pytest",
]


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


def test_the_benchmarks_page_is_short() -> None:
    assert len((ROOT / "bench" / "README.md").read_text("utf-8").splitlines()) <= 80


def test_the_bench_extra_installs_all_that_benchmarks_import() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    nested = [extra for name in ("test", "history", "plot") for extra in extras[name]]
    assert any("multidrop[test,history,plot]" in wanted for wanted in extras["bench"])
    distributions = {"pyserial": "serial", "modbus-tk": "modbus_tk", "cffi": "cffi"}
    wanted = {
        re.split(r"[\[><=; ]", text)[0] for text in [*project["dependencies"], *extras["bench"], *nested]
    }
    installed = {distributions.get(name, name) for name in wanted}
    ours = {"multidrop", "bench", *(path.stem for path in (ROOT / "tests" / "support").rglob("*.py"))}
    imported = {name.partition(".")[0] for path in files("bench") for name in run_time_imports(path)}
    assert imported - ours - set(sys.stdlib_module_names) - installed == set()


def test_the_setup_commands_in_the_readme_equal_those_of_ci_run() -> None:
    patterns = re.findall(r"grep -m1 -E '([^']+)' README\.md", (ROOT / ".ci" / "run").read_text("utf-8"))
    found = [next(line for line in README.splitlines() if re.search(pattern, line)) for pattern in patterns]
    assert sorted(found) == sorted(SETTING_UP)


@pytest.mark.slow
def test_the_ten_line_example_runs(tmp_path: Path) -> None:
    """Run the lines in a fresh interpreter without a warning."""
    (block,) = re.findall(r"^```python\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    (tmp_path / "ten_lines.py").write_text(block)
    done = subprocess.run(
        [sys.executable, "-W", "error", patient.__file__, "ten_lines.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    values, acceleration = done.stdout.splitlines()
    assert values.startswith("{'output_current': ")
    assert acceleration == "20.0 s"


def test_the_readme_lists_every_family() -> None:
    table = README.partition("## Families")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `([^`]+)`", table, re.MULTILINE) == list(MODELS)


# ---- examples ----


EXAMPLES = ROOT / "examples"

PAGES = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))


def run(directory: Path, name: str, *words: str, through: tuple[str, ...] = (patient.__file__,)) -> str:
    """Run an example; return the text that it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", *through, str(EXAMPLES / name), *words],
        cwd=directory,
        env={**os.environ, "XDG_STATE_HOME": str(directory / "state")},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@table("path", sorted(EXAMPLES.glob("*.py")))
def test_every_example_is_linked_and_tested(path: Path) -> None:
    if path.name != "simulated_plant.py":  # a module that the other examples import
        assert f"examples/{path.name}" in PAGES
        assert f'"{path.name}"' in Path(__file__).read_text("utf-8")


@pytest.mark.long
def test_the_logger_example_records_to_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    run(tmp_path, "logger.py", "--seconds", "1")
    rows = [row for batch in open_recording(tmp_path / "log.parquet") for row in batch]
    assert {row.drive for row in rows if row.status == "ok"} == {"pump", "fan"}


@pytest.mark.slow
def test_the_test_bench_example_measures_and_records_each_step(tmp_path: Path) -> None:
    lines = run(tmp_path, "test_bench.py", "0.5").splitlines()
    assert [line.partition(":")[0] for line in lines] == ["10.0 Hz", "20.0 Hz", "30.0 Hz"]
    assert {row.drive for batch in open_recording(tmp_path / "bench.arrows") for row in batch} == {"fan"}


@pytest.mark.slow
def test_the_own_device_example_runs(tmp_path: Path) -> None:
    printed = run(tmp_path, "own_device.py")
    assert "temperature  21.4 degC" in printed
    assert "FILTER" in printed
    assert "target is now 22.5" in printed
    assert "refused: roof: target = 60 is outside 5 to 30 degC" in printed


@pytest.mark.slow
def test_the_asyncio_example_runs(tmp_path: Path) -> None:
    lines = run(tmp_path, "asyncio_poll.py", "1").splitlines()
    assert "tick" in lines
    assert any(line.endswith(" rows") for line in lines)


@pytest.mark.long
def test_the_example_with_two_lines_polls_both_lines(tmp_path: Path) -> None:
    printed = run(tmp_path, "two_lines.py", "4")
    for name in ("pump-1: ", "pump-2: ", "fan-1: ", "hall-1: ", "hall-2: "):
        assert name in printed


@pytest.mark.slow
def test_the_pump_example_stops_its_motor_when_the_program_ends(tmp_path: Path) -> None:
    printed = run(tmp_path, "pump.py", "1")
    assert "failed" not in printed
    assert printed.splitlines()[-1] == "the output frequency is now 0.0 Hz"
    assert any(
        "STOP" in str(record) or "stop" in str(record) for record in read_audit(tmp_path / "pump.jsonl")
    )


@pytest.mark.long
def test_the_noise_hunt_example_finds_bad_checksums(tmp_path: Path) -> None:
    # patient.py, which other tests use, sets long timeouts: here each lost reply would wait for them
    printed = run(tmp_path, "noise_hunt.py", "5", through=())
    assert "pump-1: " in printed
    assert "bad checksum" in printed
    capture = tmp_path / "noise" / "all.pcapng"
    assert main(["decode", str(capture), "--out", str(tmp_path / "again.csv")]) == 0
    assert sum(len(batch) for batch in open_recording(tmp_path / "again.csv"))


# ---- the files in packaging/containers agree with the command line and the sources ----


FOLDER = ROOT / "packaging" / "containers"
FILES = {name: yaml.safe_load((FOLDER / name).read_text()) for name in ("compose.yaml", "fleet.yaml")}
SERVICES = {
    f"{file}: {name}": service for file, found in FILES.items() for name, service in found["services"].items()
}
OURS = {name: service for name, service in SERVICES.items() if service["image"] == "localhost/multidrop"}
PLANT = tomllib.loads((FOLDER / "plant.toml").read_text())
CONTAINERFILE = (FOLDER / "Containerfile").read_text()


def mounts(service: dict[str, Any]) -> dict[str, str]:
    """Return the sources of a service's volumes by their target."""
    found = [volume.split(":") for volume in service.get("volumes", ())]
    return {target: source for source, target, *_ in found}


@pytest.mark.long
@pytest.mark.parametrize("name", OURS)
def test_container_commands_are_valid_and_use_only_mounted_files(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words: list[str] = OURS[name]["command"]
    module: Any = importlib.import_module(f"multidrop.cli.{COMMANDS[words[0]][0]}")
    if hasattr(module, "ACTIONS"):
        module = importlib.import_module(f"{module.__name__}.{module.ACTIONS[words[1]][0]}")
    ran: list[object] = []
    monkeypatch.setattr(module, "run", lambda arguments: len(ran.append(arguments) or ""))
    assert main(words) == 0
    assert len(ran) == 1
    targets = mounts(OURS[name])
    for path in (Path(word) for word in words if word.startswith("/")):
        assert str(path) in targets or any(str(parent) in targets for parent in path.parents)


@pytest.mark.long
@pytest.mark.parametrize("file", FILES)
def test_each_container_volume_is_declared_or_is_a_file_of_the_project(file: str) -> None:
    found = FILES[file]
    sources = [source for service in found["services"].values() for source in mounts(service).values()]
    files = [source for source in sources if source.startswith(".")]
    assert [source for source in files if not (FOLDER / source).exists()] == []
    assert {*sources} - {*files} == {*found["volumes"]}
    builds = [service["build"] for service in found["services"].values() if "build" in service]
    for build in builds:
        assert (FOLDER / build["context"]).resolve() == ROOT
        assert (ROOT / build["dockerfile"]).exists()


@pytest.mark.long
def test_containers_agree_on_ports_and_listen_on_localhost_only() -> None:
    services = FILES["compose.yaml"]["services"]
    page = PLANT["serve"]["listen"]
    (scraped,) = yaml.safe_load((FOLDER / "prometheus.yml").read_text())["scrape_configs"]
    assert scraped["static_configs"] == [{"targets": [page]}]
    assert f"http://{page}/health" in services["gateway"]["healthcheck"]["test"][-1]
    (source,) = yaml.safe_load((FOLDER / "grafana/datasources/prometheus.yml").read_text())["datasources"]
    listens = {word.partition("=")[0]: word.partition("=")[2] for word in services["prometheus"]["command"]}
    assert source["url"] == f"http://{listens['--web.listen-address']}"
    broker = urlsplit(PLANT["serve"]["mqtt"]["broker"])
    assert f"listener {broker.port} {broker.hostname}" in (FOLDER / "mosquitto.conf").read_text().splitlines()
    hosts = {urlsplit(f"//{page}").hostname, broker.hostname, urlsplit(source["url"]).hostname}
    hosts |= {urlsplit(line["port"]).hostname for line in PLANT["line"]}
    hosts.add(services["grafana"]["environment"]["GF_SERVER_HTTP_ADDR"])
    assert hosts == {"127.0.0.1"}
    assert {service["network_mode"] for service in SERVICES.values()} == {"host"}


@pytest.mark.long
def test_grafana_and_prometheus_read_the_shipped_dashboard_and_rules() -> None:
    services = FILES["compose.yaml"]["services"]
    (provider,) = yaml.safe_load((FOLDER / "grafana/dashboards/multidrop.yml").read_text())["providers"]
    of_grafana, of_prometheus = mounts(services["grafana"]), mounts(services["prometheus"])
    assert of_grafana[f"{provider['options']['path']}/dashboard.json"].endswith("/prometheus/dashboard.json")
    (rules,) = yaml.safe_load((FOLDER / "prometheus.yml").read_text())["rule_files"]
    assert of_prometheus[f"/etc/prometheus/{rules}"].endswith("/prometheus/alerts.yml")
    assert services["prometheus"]["command"][0] == "--config.file=/etc/prometheus/prometheus.yml"


@pytest.mark.long
@pytest.mark.parametrize("name", SERVICES)
def test_each_container_has_no_rights_beyond_its_volumes(name: str) -> None:
    service = SERVICES[name]
    assert (service["cap_drop"], service["read_only"]) == (["ALL"], True)
    assert service["security_opt"] == ["no-new-privileges:true"]


def test_the_plant_file_for_containers_is_valid_and_has_only_tcp_ports(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["serve", "--check", str(FOLDER / "plant.toml")]) == 0
    assert "parts: history, mqtt" in capsys.readouterr().out
    assert {urlsplit(line["port"]).scheme for line in PLANT["line"]} == {"tcp"}


@pytest.mark.long
def test_the_container_image_has_the_sources_the_extras_and_an_init_process() -> None:
    copied = re.findall(r"(?m)^COPY (?!--)(.+) \S+$", CONTAINERFILE)
    assert [path for paths in copied for path in paths.split() if not (ROOT / path).exists()] == []
    (extras,) = re.findall(r"'\.\[(.+)\]'", CONTAINERFILE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    known = project["optional-dependencies"]
    assert {*extras.split(",")} <= {*known}
    libraries = {library for extra in extras.split(",") for library in known[extra]}
    assert [name for name in (*PARTS, "serve") if not {*known.get(name, ())} <= libraries] == []
    # without tini, multidrop would be process 1, which a kernel timer cannot kill
    assert 'ENTRYPOINT ["tini", "--", "multidrop"]' in CONTAINERFILE
    assert re.search(r"(?m)^USER 10001$", CONTAINERFILE)


@pytest.mark.long
def test_nats_accepts_the_configuration_of_each_server(tmp_path: Path) -> None:
    servers = {name: one for name, one in SERVICES.items() if "nats" in one["image"]}
    urls = OURS["fleet.yaml: gateway-1"]["environment"]["MULTIDROP_NATS"].split(",")
    environments = [server["environment"] for server in servers.values()]
    assert [f"nats://127.0.0.1:{one['PORT']}" for one in environments] == urls
    text = (FOLDER / "nats.conf").read_text()
    assert re.findall(r"nats-route://127\.0\.0\.1:(\d+)", text) == [one["ROUTES"] for one in environments]
    (tmp_path / "nats.conf").write_text(text.replace('"/data"', f'"{tmp_path}"'))
    for one in environments:
        check = [server_program(), "-t", "-c", tmp_path / "nats.conf"]
        checked = subprocess.run(check, env=one, capture_output=True, text=True, check=False)
        assert checked.returncode == 0, checked.stderr


# ---- tests/README.md: each promise has a row, and the named files, tests and commands exist ----


PAGE = (ROOT / "tests" / "README.md").read_text("utf-8")
PROMISES = (
    "the wire is the limit",
    "the host costs almost nothing",
    "Python never disturbs the cadence",
    "many lines",
    "a busy computer",
    "dead drives cost nothing",
    "noise costs one exchange",
    "a late reply is never taken for another's answer",
    "what is recorded is true",
    "memory is flat",
)
CODE = re.findall(r"`([^`\n]+)`", PAGE)
FILE = r"(?:tests|bench|csrc|src|docs|\.ci)/[\w./]*\w/?"


def rows() -> dict[str, list[str]]:
    """Return the cells of the first table, by promise."""
    table = PAGE.partition("## The promises")[2].partition("\n## ")[0]
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in re.findall(r"^\|.*", table, re.M)
    ]
    return {promise: others for promise, *others in cells[2:]}


def test_the_promises_table_lists_tests_for_every_promise() -> None:
    assert tuple(rows()) == PROMISES
    for _, decided, measured in rows().values():
        assert re.search(r"`tests/\w+/test_\w+\.py`", decided)
        assert re.search(r"bench/?\w*", measured)


def named(pattern: str) -> list[str]:
    return sorted({name for code in CODE for name in re.findall(rf"(?<![\w./]){pattern}", code)})


def test_every_file_named_in_the_test_readme_exists() -> None:
    paths = named(FILE)
    assert len(paths) > 90
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_every_test_named_in_the_test_readme_exists() -> None:
    """Check that each named test is in the file that the page names before it."""
    missing, number, file = [], 0, ""
    for path, name in re.findall(r"(tests/[\w/]+/test_\w+\.py)|`(test_\w+)`", PAGE):
        file = path or file
        if name and f"def {name}(" not in text_of(file):
            missing.append(f"{file}: {name}")
        number += bool(name)
    assert number > 70
    assert missing == []


@cache
def text_of(file: str) -> str:
    return (ROOT / file).read_text("utf-8")


def script(command: str) -> Path | None:
    """Return the file of this project that a command runs, or None."""
    if module := re.search(r"-m (bench[\w.]+)", command):
        return ROOT / f"{module[1].replace('.', '/')}.py"
    files = [ROOT / file for file in re.findall(FILE, command)]
    return files[0] if files and files[0].suffix == ".py" else None


def test_every_command_and_option_named_in_the_test_readme_exists() -> None:
    common = (ROOT / "tests" / "conftest.py").read_text("utf-8")
    commands = {command: file for command in CODE if (file := script(command))}
    assert len(commands) > 90
    for command, file in commands.items():
        sources = file.read_text("utf-8") + common
        for option in re.findall(r"--[\w-]+", command):
            assert f'"{option}"' in sources, command
