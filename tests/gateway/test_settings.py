"""The table `[serve]` of a plant file: its keys, and the report of all mistakes together."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from gateways import certificate, plant_text, written
from tables import table

from multidrop import Plant, PlantError
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Right, digest, new_token, read_tokens
from multidrop.gateway.settings import read_plant, read_settings

SHA = digest("secret")
NAMES = ("pump-1", "pump-2", "fan-1")


def mistakes(folder: Path, serve: str) -> list[str]:
    with pytest.raises(PlantError) as wrong:
        read_settings(written(folder, serve), {})
    start = re.compile(re.escape(str(folder / "plant.toml")) + r":\d+: ")
    assert all(start.match(mistake) for mistake in wrong.value.mistakes)
    return [start.sub("", mistake, count=1) for mistake in wrong.value.mistakes]


def test_a_plant_file_without_serve_settings_lets_only_local_clients_read(tmp_path: Path) -> None:
    settings = read_settings(written(tmp_path), {})
    assert (settings.host, settings.port) == ("127.0.0.1", 8750)
    assert settings.may.without_token(is_loopback=True) is Right.LOOK
    assert settings.may.write == settings.may.verbs == frozenset()
    assert settings.audit == tmp_path / "audit.jsonl"
    assert not (tmp_path / "audit.jsonl").exists()


def test_all_keys_of_the_serve_table_are_read(tmp_path: Path) -> None:
    certificate(tmp_path, "own")
    (tmp_path / "tokens").write_text(f"# people\n\nanna stop {SHA}\nscada write {digest('other')}\n")
    serve = """
[serve]
listen = "0.0.0.0:8443"
names = ["plant.example"]
certificate = "own.pem"
key = "own.key"
tokens = "tokens"
audit = "log/audit.jsonl"
[serve.may]
look = "token"
stop = "anyone"
write = ["pump-1.setpoint"]
verbs = ["pump-1.start", "pump-2.reset_fault"]
"""
    (tmp_path / "log").mkdir()
    settings = read_settings(written(tmp_path, serve), {})
    assert settings.tls is not None
    assert [(token.name, token.right) for token in settings.tokens] == [
        ("anna", Right.STOP),
        ("scada", Right.WRITE),
    ]
    assert settings.may.write == {"pump-1.setpoint"}
    assert settings.may.verbs == {"pump-1.start", "pump-2.reset_fault"}
    assert settings.may.without_token(is_loopback=True) is Right.STOP
    assert settings.may.without_token(is_loopback=False) is None


def test_fourteen_mistakes_in_the_serve_table_are_reported_together(tmp_path: Path) -> None:
    (tmp_path / "tokens").write_text("anna stop 1234\nanna look\n")
    (tmp_path / "key.pem").write_text("no key\n")
    serve = """
[serve]
listen = "everywhere"
names = ["http://plant.example/"]
nmaes = ["plant.example"]
certificate = "cert.pem"
key = "key.pem"
behind_proxy = "yes"
tokens = "tokens"
audit = "no/such/folder/audit.jsonl"
[serve.may]
look = "everybody"
write = ["pump-1.output_current", "pump-9.setpoint", "setpoint", "pump-1.setpint"]
verbs = ["pump-1.fly"]
[serve.mqqt]
"""
    found = mistakes(tmp_path, serve)
    expected = [
        "[serve]: unknown key 'nmaes'; did you mean names?",
        "[serve]: unknown key 'mqqt'; did you mean mqtt?",
        "[serve]: behind_proxy = 'yes' is not right; write behind_proxy = true",
        '[serve]: "everywhere" is not an address and port; write listen = "127.0.0.1:8750"',
        "[serve]: names: 'http://plant.example/' is not a host name; write names = [\"plant.example\"], "
        "without a port",
        f"[serve]: certificate {tmp_path}/cert.pem cannot be read: No such file or directory",
        f"[serve]: tokens {tmp_path}/tokens: line 1 is not `name role sha256`; `multidrop serve --new-token` "
        "prints one",
        f"[serve]: tokens {tmp_path}/tokens: line 2 is not `name role sha256`; `multidrop serve --new-token` "
        "prints one",
        '[serve.may]: look = "everybody" is neither "anyone" nor "token"',
        "[serve.may]: write: pump-1.output_current is never written: the register can only be read",
        "[serve.may]: write: there is no drive 'pump-9'; did you mean pump-2 or pump-1?",
        "[serve.may]: write: 'setpoint' is not right; write write = [\"pump-1.frequency_setpoint\"]",
        "[serve.may]: write: pump-1.setpint: INVT CHE has no register 'setpint'; did you mean setpoint or "
        "pid_setpoint?",
        "[serve.may]: verbs: 'fly' of pump-1 cannot be allowed; choose from start, jog, "
        "reset_fault, set_frequency, coast",
        f"[serve]: audit {tmp_path}/no/such/folder/audit.jsonl cannot be written: No such file or directory",
    ]
    assert sorted(found) == sorted(expected)


PLACED = """\
[serve]
lisen = "127.0.0.1:8750" # wrong
names = ["http://plant.example/"] # wrong
tokens = "none" # wrong
audit = "no/such/folder/audit.jsonl" # wrong
[serve.may]
look = "everybody" # wrong
write = ["pump-9.setpoint"] # wrong
family.invt-chf = { write = ["setpoint"] } # wrong
[[serve.limit]]
drive = "pump-1"
register = "output_current"
above = 1
for = "5" # wrong
[[serve.limit]] # wrong
drive = "pump-1"
register = "output_curent"
above = 1
[serve.mqqt] # wrong
[serve.mqtt]
every = "1 day" # wrong
password = 3 # wrong
[serve.modbus]
listen = "1502" # wrong
units = { pump-1 = 700 } # wrong
"""


def test_each_mistake_in_the_serve_table_names_the_line_of_its_key(tmp_path: Path) -> None:
    plant = written(tmp_path, PLACED)
    with pytest.raises(PlantError) as wrong:
        read_settings(plant, {})
    lines = plant.path.read_text().splitlines()
    named = {int(one.removeprefix(str(plant.path)).split(":")[1]) for one in wrong.value.mistakes}
    assert named == {number for number, line in enumerate(lines, 1) if line.endswith("# wrong")}


@table(
    ("may", "write", "verbs"),
    [
        ('verbs = ["pump-*.start"]', set(), {"pump-1.start", "pump-2.start"}),
        ('verbs = ["*.start"]', set(), {"pump-1.start", "pump-2.start", "fan-1.start"}),
        ('verbs = ["*-1.start"]', set(), {"pump-1.start", "fan-1.start"}),
        ('write = ["p*p-1.setpoint"]', {"pump-1.setpoint"}, set()),
        ('family.invt-che = { write = ["setpoint"] }', {f"{name}.setpoint" for name in NAMES}, set()),
        (
            'verbs = ["fan-*.start"]\nfamily.invt-che = { verbs = ["reset_fault"] }',
            set(),
            {"fan-1.start", *(f"{name}.reset_fault" for name in NAMES)},
        ),
    ],
)
def test_rights_with_patterns_or_families_apply_only_to_matching_drives(
    tmp_path: Path, may: str, write: set[str], verbs: set[str]
) -> None:
    found = read_settings(written(tmp_path, f"[serve.may]\n{may}\n", *NAMES), {}).may
    assert (found.write, found.verbs) == (write, verbs)


def test_a_pattern_allows_writes_only_to_drives_with_that_register(tmp_path: Path) -> None:
    mixed = plant_text("/dev/ttyUSB0", NAMES, '[serve.may]\nwrite = ["*.setpoint"]\n').replace(
        'name = "fan-1"\nmodel = "invt-che"', 'name = "fan-1"\nmodel = "yd1000"'
    )
    (tmp_path / "plant.toml").write_text(re.sub(r"(?m)^(poll|baudrate) = .*$", "", mixed))
    found = read_settings(Plant.load(tmp_path / "plant.toml"), {}).may
    assert found.write == {"pump-1.setpoint", "pump-2.setpoint"}


def test_a_drive_name_with_a_star_is_not_read_as_a_pattern(tmp_path: Path) -> None:
    plant = written(tmp_path, '[serve.may]\nverbs = ["p*.start"]\n', "p*", "pump-1")
    assert read_settings(plant, {}).may.verbs == {"p*.start"}


@table(
    ("may", "sentence"),
    [
        ('verbs = ["fan-?.start"]', "there is no drive 'fan-?'; did you mean fan-1"),
        ('verbs = ["pump-1.*"]', "'*' of pump-1 cannot be allowed; choose from start, "),
        (
            'verbs = ["*.stop"]',
            "*.stop matches no register or verb: 'stop' of fan-1 cannot be allowed",
        ),
        ('verbs = ["Pump-*.start"]', "Pump-*.start matches no register or verb: there is no drive 'Pump-*'"),
        (
            'write = ["*.output_current"]',
            "fan-1.output_current is never written: the register can only be read",
        ),
        ('write = ["*"]', "'*' is not right; write write = "),
        (
            'family.yd1000 = { verbs = ["start"] }',
            "family yd1000: no drive has this model; the plant has invt-che",
        ),
        (
            'family.invt-che = { verbs = ["pump-1.start"] }',
            "'pump-1.start' of pump-1 cannot be allowed",
        ),
        ('family.invt-che = { look = ["token"] }', "family invt-che: unknown key 'look'"),
        ('family.invt-che = ["start"]', "family invt-che: ['start'] is not a table with write, verbs"),
    ],
)
def test_a_right_that_matches_no_drive_is_refused(tmp_path: Path, may: str, sentence: str) -> None:
    with pytest.raises(PlantError) as wrong:
        read_settings(written(tmp_path, f"[serve.may]\n{may}\n", *NAMES), {})
    assert any(sentence in mistake for mistake in wrong.value.mistakes), wrong.value.mistakes


def test_mistakes_in_lines_and_in_the_serve_table_are_reported_together(tmp_path: Path) -> None:
    serve = """
[serve]
listen = 80
[serve.may]
look = "everybody"
write = ["pump-1.setpoint"]
[serve.modbus]
may = "all"
units = { pump-1 = 7 }
"""
    path = tmp_path / "plant.toml"
    path.write_text(plant_text("/dev/ttyUSB0", ["pump-1"], serve).replace("invt-che", "invt-chx"))
    with pytest.raises(PlantError) as wrong:
        read_plant(lambda: Plant.load(path), {})
    assert [mistake.split(": ")[1] for mistake in wrong.value.mistakes] == [
        'line "hall", drive "pump-1"',
        "[serve]",
        "[serve.may]",
        "[serve.modbus]",
    ]
    path.write_text("no TOML")
    with pytest.raises(PlantError, match="is not TOML"):
        read_plant(lambda: Plant.load(path), {})


@pytest.mark.slow
@table(
    ("keys", "is_right"),
    [
        ("", False),
        ('tokens = "tokens"', False),
        ('certificate = "own.pem"\nkey = "own.key"', False),
        ('certificate = "own.pem"\nkey = "own.key"\ntokens = "tokens"', True),
        ("behind_proxy = true", True),
    ],
)
@table("address", ["0.0.0.0:80", "[::]:80", "10.0.0.7:80", "plant.example:80"])
def test_access_from_other_machines_needs_tokens_and_tls(
    tmp_path: Path, certificates: Path, address: str, keys: str, is_right: bool
) -> None:
    for name in ("own.pem", "own.key"):
        (tmp_path / name).write_bytes((certificates / name).read_bytes())
    (tmp_path / "tokens").write_text(f"anna stop {SHA}\n")
    serve = f'[serve]\nlisten = "{address}"\n{keys}\n'
    if is_right:
        assert read_settings(written(tmp_path, serve), {}).port == 80
        return
    (only,) = mistakes(tmp_path, serve)
    assert only == (
        f'[serve]: listen = "{address}" is open to other machines. Add tokens, certificate and key, '
        "or behind_proxy = true; or listen on 127.0.0.1"
    )


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two certificates and their private keys."""
    folder = tmp_path_factory.mktemp("certificates")
    certificate(folder, "own")
    certificate(folder, "other")
    return folder


@pytest.mark.parametrize(
    ("pair", "why"),
    [
        (("own.pem", "other.key"), "do not belong together"),
        (("own.key", "own.key"), "must be a certificate and a key in PEM, without password"),
        (("own.pem", "own.pem"), "must be a certificate and a key in PEM, without password"),
    ],
)
def test_invalid_certificates_and_wrong_private_keys_are_reported(
    tmp_path: Path, certificates: Path, pair: tuple[str, str], why: str
) -> None:
    paths = [certificates / name for name in pair]
    (only,) = mistakes(tmp_path, f'[serve]\ncertificate = "{paths[0]}"\nkey = "{paths[1]}"\n')
    assert only == f"[serve]: certificate {paths[0]} and key {paths[1]} {why}"


@table(
    ("keys", "sentences"),
    [
        ('pre = "5 s"', ["conditions is missing; add conditions = { trip = "]),
        (
            'post = "5"\nconditions = { a = 3, "\\u0007" = "fault" }',
            [
                "post = '5' is not a duration",
                "a = 3 is not a condition",
                "a trigger's name has 1 to 60 printable",
            ],
        ),
        (
            'conditions = { a = "output_current > 30", b = "pump-1.outptu_current > 3" }',
            [
                "output_current > 30: the name output_current needs a drive, such as pump-1.output_current",
                "pump-1.outptu_current > 3: column 1: ",
            ],
        ),
    ],
)
def test_mistakes_in_triggers_are_reported(tmp_path: Path, keys: str, sentences: list[str]) -> None:
    found = mistakes(tmp_path, f"[serve.trigger]\n{keys}\n")
    assert len(found) == len(sentences)
    for sentence in sentences:
        assert any(one.startswith(f"[serve.trigger]: {sentence}") for one in found), found


@table(
    ("serve", "sentences"),
    [
        (
            '[serve.modbus]\nlisten = "127.0.0.1:8750"\n[serve.opcua]\nlisten = "127.0.0.1:8750"',
            [
                "[serve.modbus]: listen: port 8750 is in use by listen of [serve]",
                "[serve.opcua]: listen: port 8750 is in use by listen of [serve]",
            ],
        ),
        (
            '[serve]\nlisten = "localhost:4840"\n[serve.opcua]',
            ["[serve.opcua]: listen: port 4840 is in use by listen of [serve]"],
        ),
        (
            '[serve]\nbehind_proxy = true\nlisten = "0.0.0.0:1503"\n[serve.modbus]\nports = { hall = 1503 }',
            ["[serve.modbus]: ports.hall: port 1503 is in use by listen of [serve]"],
        ),
        (
            '[serve.modbus]\n[serve.tool]\nclients = ["::1"]\nrtu = { hall = "[::]:1502" }',
            ["[serve.tool]: rtu.hall: port 1502 is in use by listen of [serve.modbus]"],
        ),
    ],
)
def test_each_setting_with_a_used_tcp_port_is_reported_once(
    tmp_path: Path, serve: str, sentences: list[str]
) -> None:
    assert mistakes(tmp_path, f"{serve}\n") == [f"{one}; choose another port" for one in sentences]


def test_two_settings_may_use_the_same_tcp_port_on_different_addresses(tmp_path: Path) -> None:
    serve = '[serve]\nlisten = "{}"\n[serve.modbus]\nlisten = "{}"\nclients = ["::1"]\n'
    for page, modbus in (("127.0.0.1", "127.0.0.2"), ("[::1]", "127.0.0.1"), ("[::1]", "0.0.0.0")):
        read_settings(written(tmp_path, serve.format(f"{page}:1502", f"{modbus}:1502")), {})
    read_settings(written(tmp_path, serve.format("127.0.0.1:0", "127.0.0.1:0")), {})


@table(
    ("serve", "library", "extra"),
    [
        ("[serve.opcua]", "asyncua", "opcua"),
        ("[serve.mqtt]", "paho", "mqtt"),
        ("[serve.mqtt]\nrows = true", "pyarrow", "parquet"),
        ("[serve.notify]", "apprise", "notify"),
    ],
)
def test_a_missing_library_is_reported(tmp_path: Path, serve: str, library: str, extra: str) -> None:
    (tmp_path / "targets").write_text("ntfy://alarms\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, library, None)
        (only,) = mistakes(tmp_path, f"{serve}\n")
    start = f"{serve.split()[0]}: the library {library} is not installed: pip install "
    assert only.startswith(start)
    assert f"multidrop[{extra}]" in only


@table("host", ["pump 1", "10.0.0", "10.0.0.256", "10.0.0.5:1502", "http://plant", "[10.0.0.5]x", "[::1"])
def test_an_invalid_host_in_a_listen_address_is_reported(tmp_path: Path, host: str) -> None:
    tables = '[serve]\nlisten = "{0}"\n[serve.opcua]\nlisten = "{0}"\n[serve.modbus]\nlisten = "{0}"\n{1}\n'
    clients = 'clients = ["::1"]\n[serve.tool]\nclients = ["::1"]\nrtu = {{ hall = "{0}" }}'
    found = mistakes(tmp_path, tables.format(f"{host}:80", clients.format(f"{host}:80")))
    assert [one.split(": ")[0] for one in found] == [
        *("[serve]", "[serve.modbus]", "[serve.opcua]", "[serve.tool]")
    ]
    assert all(f'"{host}:80" is not an address and port; write ' in one for one in found)


def test_a_certificate_without_its_private_key_is_reported(tmp_path: Path, certificates: Path) -> None:
    (only,) = mistakes(tmp_path, f'[serve]\ncertificate = "{certificates}/own.pem"\n')
    assert only == "[serve]: certificate alone is not enough: give both keys, certificate and key"


def test_an_audit_log_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    """The test uses /sys, where not even root may create a file."""
    with pytest.raises(PlantError) as wrong:
        read_settings(written(tmp_path), {"STATE_DIRECTORY": "/sys"})
    (only,) = wrong.value.mistakes
    assert only.endswith(": [serve]: audit /sys/audit.jsonl cannot be written: Permission denied")


def test_credentials_and_state_folder_of_systemd_replace_the_default_files(tmp_path: Path) -> None:
    """Its credentials are used rather than files beside the plant file; output is in its state folder."""
    credentials, state = tmp_path / "credentials", tmp_path / "state"
    credentials.mkdir()
    state.mkdir()
    (credentials / "tokens").write_text(f"anna stop {SHA}\n")
    environment = {"CREDENTIALS_DIRECTORY": str(credentials), "STATE_DIRECTORY": f"{state}:/other"}
    settings = read_settings(written(tmp_path, '[serve]\ntokens = "tokens"\n'), environment)
    assert [token.name for token in settings.tokens] == ["anna"]
    assert settings.folder == state
    assert settings.audit == state / "audit.jsonl"


def test_a_missing_token_file_is_reported_if_a_setting_requires_tokens(tmp_path: Path) -> None:
    (only,) = mistakes(tmp_path, '[serve.may]\nlook = "token"\n')
    assert only == ('[serve]: look = "token" of [serve.may] needs a file of tokens; add tokens = "tokens"')


def test_the_token_file_contains_no_secret() -> None:
    secret, token = new_token("anna", Right.STOP)
    assert read_tokens(f"{token.line}\n") == ([token], [])
    assert secret not in token.line
    assert read_tokens(f"{token.line}\n{token.line}\n")[1] == [
        "line 2: the name anna is in use already; give each token its own"
    ]


def test_a_tcp_port_in_use_is_reported() -> None:
    with listen("127.0.0.1", 0) as first:
        port = first.getsockname()[1]
        with pytest.raises(
            OSError, match=f"listen: 127.0.0.1:{port} cannot be opened: another program listens"
        ):
            listen("127.0.0.1", port)
    with pytest.raises(
        OSError, match=r"listen: 192\.0\.2\.1:80 cannot be opened: this machine does not have this"
    ):
        listen("192.0.2.1", 80)
    with pytest.raises(OSError, match=r"listen: this machine does not have the address nowhere\.invalid"):
        listen("nowhere.invalid", 80)
