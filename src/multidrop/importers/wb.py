"""Import wb-mqtt-serial's device templates and its configuration from JSON.

Import your own templates, because most published ones may not be copied. The key tables follow its JSON
schemas and README.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.drive.register import LANGUAGES
from multidrop.families.files.registers import LONGEST_TITLE
from multidrop.importers.device import (
    UNKNOWN_LINE,
    ImportedDevice,
    ImportedRegister,
    LineSettings,
    key_table,
    network_settings,
    serial_settings,
    unimported_keys,
    unit_address,
)
from multidrop.importers.parsing import bits_text, count, float_of_bits, put_number, scaled, whole, words_of

# Matches strings, which are kept, and comments and trailing commas, which JSON forbids. A string or comment
# without an end extends to the end of the text, so that each character is scanned only once.
_NOT_JSON = re.compile(r'("(?:\\.|[^"\\])*+(?:"|\\?\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|,(?=\s*[\]}])', re.DOTALL)
MOST_READ = 125
_DEEPEST = 8  # limit of subdevices within subdevices
# key that marks an entry as one of several parts of a channel; reports show it as an unimported key
PART = "its place in a larger channel"
_TABLES = {
    **{"holding": "holding", "holding_single": "holding", "holding_multi": "holding"},
    **{"input": "input", "coil": "coil", "discrete": "discrete"},
}
_FORMATS = {
    **{"u8": "U16", "u16": "U16", "u24": "U32", "u32": "U32", "u64": "U64"},
    **{"s8": "I8", "s16": "I16", "s24": "I32", "s32": "I32", "s64": "I64"},
    **{"float": "F32", "double": "F64"},
    **{"bcd8": "BCD16", "bcd16": "BCD16", "bcd24": "BCD32", "bcd32": "BCD32"},
}
# width in bits of formats that do not use all bits of their words
_WIDTHS = {"u8": 8, "s8": 8, "u24": 24, "s24": 24}
# order of characters; B: one character in each register, in its low byte
_TEXTS = {"string": "B", "char8": "B", "string8": ""}
_ORDERS = {"big_endian": False, "little_endian": True}
_ORDER_OF = {(False, False): "", (True, False): "CDAB", (False, True): "BADC", (True, True): "DCBA"}
_ENTRY = "name id title address write_address reg_type format units scale offset word_order byte_order"
_SHOWN = (
    "enabled type control_type max min default order required group description dependencies hidden "
    "read_period_ms read_rate_limit_ms poll_interval mode precision unit ui_options original_name"
)
CHANNEL_KEYS = {
    PART: True,
    **key_table(
        imported=f"{_ENTRY} error_value unsupported_value string_data_size readonly enum enum_titles "
        "consists_of device_type oneOf shift stride",
        irrelevant=_SHOWN,
        gap="condition fw sporadic semi-sporadic round_to on_value off_value",
    ),
}
DEVICE_KEYS = key_table(
    imported="name protocol channels parameters subdevices setup max_read_registers title shift stride "
    "slave_id translations",
    irrelevant="response_timeout id enabled groups device_type deprecated hw "
    "read_rate_limit_ms max_reg_hole max_bit_hole min_read_registers max_write_registers "
    "response_timeout_ms device_timeout_ms password device_max_fail_cycles max_write_fail_time_s "
    "preserve_setup_order enable_wb_continuous_read force_frame_timeout "
    "continue_polling_on_illegal_modbus_exception",
    gap="min_request_interval guard_interval_us frame_timeout_ms access_level standard_channels",
)
TEMPLATE_KEYS = key_table(imported="title device", irrelevant="device_type group deprecated hw")
PORT_KEYS = key_table(
    imported="port_type path baud_rate parity data_bits stop_bits address port devices",
    irrelevant="enabled response_timeout_ms read_rate_limit_ms connection_timeout_ms "
    "connection_max_fail_cycles connected_to_mge",
    gap="guard_interval_us",
)


def json_without_comments(text: str) -> str:
    """Return valid JSON: remove the comments and trailing commas that wb-mqtt-serial allows."""
    return _NOT_JSON.sub(lambda found: found[1] or "", text)


def read_wb(document: Any) -> list[ImportedDevice]:
    """Return the devices of a wb-mqtt-serial template or configuration file.

    Raises ValueError for other documents.
    """
    if not isinstance(document, dict):
        kind = type(document).__name__
        raise ValueError(f"the file is neither a wb-mqtt-serial template nor a SunSpec model: it is a {kind}")
    if isinstance(ports := document.get("ports"), list):
        return [device for port in ports for device in _of_port(port)]
    template = document.get("device", document)
    if not isinstance(template, dict) or not {"channels", "parameters", "subdevices"} & template.keys():
        keys = ", ".join(str(key)[:40] for key in list(document)[:8])
        raise ValueError(
            "the file has no `device` with channels or parameters (wb-mqtt-serial) and no `group` with "
            f"points (SunSpec): its keys are {keys}"
        )
    title = str(document.get("title") or template.get("name") or "")
    device = _device(template, title, None, UNKNOWN_LINE)
    if template is not document:
        device.lose_keys("the template", document, TEMPLATE_KEYS)
    return [device]


def _of_port(port: Mapping[str, Any]) -> Iterator[ImportedDevice]:
    """Yield the devices of one port in a configuration, with address and line settings."""
    kind = str(port.get("port_type", "serial"))
    if "tcp" in kind:
        line = network_settings(
            port.get("address"), port.get("port", 502), is_serial_frames=not kind.startswith("modbus")
        )
    else:
        line = serial_settings(port, port=port.get("path", ""))
    for template in port.get("devices") or ():
        title = str(template.get("name") or template.get("device_type") or "device")
        try:
            # the other keys are values for parameters of the device's template
            known = {key: value for key, value in template.items() if key in DEVICE_KEYS}
            device = _device(known, title, unit_address(template.get("slave_id"), "slave_id"), line)
        except ValueError as mistake:
            device = ImportedDevice(title, line=line)
            device.lose(title, f"it cannot be read: {mistake}")
        if "device_type" in template:
            reason = "it refers to a template of that name: import that one too"
            device.lose(f"device_type {str(template['device_type'])[:40]}", reason, is_entry=False)
        device.lose_keys("the port", port, PORT_KEYS)
        yield device


def _device(
    template: Mapping[str, Any], title: str, address: int | None, line: LineSettings
) -> ImportedDevice:
    protocol = str(template.get("protocol", "modbus"))
    if not protocol.startswith("modbus"):
        raise ValueError(f"the file is a template of another protocol than Modbus: {protocol[:40]!r}")
    device = ImportedDevice(title, address, line=line)
    most = template.get("max_read_registers")
    device.together = most if isinstance(most, int) and 1 <= most <= MOST_READ else 0
    shift, stride = whole(template, "shift", 0), whole(template, "stride", 0)
    _Walk(device, template, "modbus-io" in protocol).add(template, (), shift, stride)
    device.lose_keys("the device", template, DEVICE_KEYS)
    return device


class _Walk:
    """Goes through the entries of a template, and of the subdevices that its channels use."""

    def __init__(self, device: ImportedDevice, template: Mapping[str, Any], is_shifted: bool) -> None:
        self._device = device
        self._is_shifted = is_shifted
        self._subdevices: dict[str, Mapping[str, Any]] = {}
        self._unused: set[str] = set()
        self._words: dict[str, dict[str, str]] = {language: {} for language in LANGUAGES}
        self._declare(template)

    def _declare(self, template: Mapping[str, Any]) -> None:
        given = template.get("translations")
        translations: dict[str, Any] = given if isinstance(given, dict) else {}
        for language, words in self._words.items():
            found = translations.get(language)
            for text, translation in found.items() if isinstance(found, dict) else ():
                if isinstance(translation, str) and translation.strip():
                    words.setdefault(text, translation.strip())
        for each in template.get("subdevices") or ():
            kind = str(each["device_type"])
            self._subdevices[kind] = each["device"]
            self._unused.add(kind)

    def add(self, template: Mapping[str, Any], outer: tuple[str, ...], shift: int, stride: int) -> None:
        """Add entries of a template; `outer` names the channels that contain them, the outermost first."""
        for key in ("channels", "parameters"):
            for name, entry in _flat(_listed(template.get(key))):
                with self._device.entry(" ".join((*outer, name))):
                    self._entry((*outer, name), entry, shift, stride)
        if template.get("setup"):
            reason = "writes at every start are never sent, for they wear the EEPROM"
            self._device.lose("setup", reason, is_entry=False)
        for kind in () if outer else sorted(self._unused):
            self._device.lose(f"subdevice {kind}", "no channel uses it, so its address is not known")

    def _titles(self, path: tuple[str, ...], entry: Mapping[str, Any]) -> dict[str, str]:
        """Return the titles of an entry by language; the last name in `path` is that of the entry."""
        *outer, name = path
        found = {}
        for language, words in self._words.items():
            if own := words.get(name) or words.get(str(entry.get("title"))):
                found[language] = " ".join([*(words.get(one, one) for one in outer), own])[:LONGEST_TITLE]
        return found

    def _entry(self, path: tuple[str, ...], entry: Mapping[str, Any], shift: int, stride: int) -> None:
        name = " ".join(path)
        if "device_type" not in entry and "oneOf" not in entry:
            if {"address", "write_address"} & entry.keys():
                titles = self._titles(path, entry)
                _add(self._device, name, titles, entry, shift, stride, self._is_shifted)
            elif "consists_of" not in entry:
                self._device.lose(name, "it has no address")
            return
        kind = str(entry.get("device_type"))
        self._unused -= {kind, *map(str, entry.get("oneOf") or ())}
        if "oneOf" in entry:
            choices = ", ".join(str(each)[:40] for each in entry["oneOf"][:5])
            self._device.lose(name, f"the configuration chooses which subdevice it is: {choices}")
        elif kind not in self._subdevices:
            self._device.lose(name, f"its subdevice {kind[:40]} is not in this file")
        elif len(path) > _DEEPEST:
            self._device.lose(name, f"more than {_DEEPEST} subdevices in each other")
        else:
            inner = self._subdevices[kind]
            self._declare(inner)
            self._unused.discard(kind)
            further = shift + whole(entry, "shift", 0)
            self.add(inner, path, further, whole(entry, "stride", 0))


def _listed(found: Any) -> list[tuple[str, Any]]:
    return list(found.items()) if isinstance(found, dict) else [("", entry) for entry in found or ()]


def _flat(listed: list[tuple[str, Any]]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the entries. An entry that consists of several parts is replaced by its parts."""
    for key, entry in listed:
        if isinstance(entry, dict):
            name = str(entry.get("name") or key or entry.get("id") or entry.get("title") or "channel")
            yield name, entry
            parts = entry.get("consists_of")
            for part in parts if isinstance(parts, list) else ():
                if isinstance(part, dict):
                    yield name, {**part, PART: True}


# ---- entries ----


def _add(
    device: ImportedDevice,
    name: str,
    titles: dict[str, str],
    entry: Mapping[str, Any],
    shift: int,
    stride: int,
    is_shifted: bool,
) -> None:
    kind, format = str(entry.get("reg_type", "holding")), str(entry.get("format", "u16"))
    table = _TABLES.get(kind)
    if table is None:
        device.lose(name, f"its register type {kind} has no table")
        return
    is_number = table in ("holding", "input")
    if is_number and format not in _FORMATS and format not in _TEXTS:
        device.lose(name, f"its format {format} has no number format")
        return
    elsewhere = entry.get("write_address")
    size = words_of(_FORMATS.get(format, "U16")) if is_number else 1
    base = shift + stride * size
    address, bits = _place(entry.get("address", elsewhere))
    register = ImportedRegister(name, base + address, table, is_read="address" in entry)
    register.gaps += unimported_keys(entry, CHANNEL_KEYS)
    if is_shifted:
        register.gaps.append("its address: modbus-io adds a shift that depends on the module's place")
    if is_number and format in _TEXTS:
        _text(device, register, format, entry)
        return
    if titles:
        register.details["title"] = titles
    if entry.get("units"):
        register.details["unit"] = str(entry["units"])
    register.note_write(is_written=table in ("holding", "coil") and not entry.get("readonly"))
    if is_number:
        _number(register, format, bits, entry)
    if kind == "holding_multi":
        register.of_writes["write"] = "multiple"
    if elsewhere is not None and register.is_read:
        register.of_writes["ram_address"] = base + _place(elsewhere)[0]
        register.gaps.append(f"it is written at another address, {register.of_writes['ram_address']:04X}H")
    device.add(register)


def _number(
    register: ImportedRegister, format: str, bits: tuple[int, int] | None, entry: Mapping[str, Any]
) -> None:
    number, part = _number_of_bits(register, format, bits)
    order = _ORDER_OF[_is_little(entry, "word_order"), _is_little(entry, "byte_order")]
    put_number(register.details, number, order)
    if part:
        register.details["part"] = part
    if format in ("bcd8", "bcd24"):
        register.gaps.append(f"its format {format} has fewer digits than its registers hold")
    scaled(register.details, entry.get("scale") or 1, entry.get("offset"))
    _invalid(register, entry)
    values, titles = entry.get("enum"), entry.get("enum_titles")
    if isinstance(values, list) and isinstance(titles, list):
        if _is_plain(register):
            named: dict[str, Any] = {}
            for title, value in zip(map(str, titles), values, strict=False):
                named.setdefault(f"{title} {value}" if title in named else title, value)
            register.put_names("values", named)
        elif titles:
            register.gaps.append("enum was not carried over: its names are of values with a step")


def _number_of_bits(register: ImportedRegister, format: str, bits: tuple[int, int] | None) -> tuple[str, str]:
    """Return the number format, and the bits that the format or the address selects; "" for all bits."""
    number = _FORMATS[format]
    own = _WIDTHS.get(format, 16 * words_of(number))
    if bits is None and (own == 16 * words_of(number) or number == "I8"):
        return number, ""
    shift, width = bits or (0, own)
    width = width or own
    words = -(-max(own, shift + width) // 16)  # number of registers over which the bits extend
    if number[0] not in "UI" or words not in (1, 2, 4):
        register.lacks = f"its bits {shift} to {shift + width - 1} of the format {format}"
        return number, ""
    sign = number[0] if width == own else "U"  # a number that uses only some bits is unsigned
    part = "" if (shift, width) == (0, 16 * words) else bits_text(shift, shift + width - 1)
    return f"{sign}{16 * words}", part


def _invalid(register: ImportedRegister, entry: Mapping[str, Any]) -> None:
    """Set the raw counts that mean "no value". For a float, the source file has them as bit patterns."""
    number = str(register.details.get("number_format", ""))
    bits = 8 if number == "I8" else 16 * words_of(number)
    found: list[float | str] = []
    for key in ("error_value", "unsupported_value"):
        if key not in entry:
            continue
        given = count(entry[key], key)
        if number.startswith("F"):
            found.append(float_of_bits(given, number) if isinstance(given, int) and given >= 0 else given)
        elif isinstance(given, str) or given >> bits:
            register.gaps.append(f"{key} {entry[key]} is no count of {bits} bits, and was not carried over")
        else:
            found.append(given - (1 << 64) if given >> 63 else given)  # TOML numbers are signed
    if found:
        register.details["invalid"] = found if len(found) > 1 else found[0]


def _is_plain(register: ImportedRegister) -> bool:
    """Return True if the register's raw counts can be named, because it has no step, offset or the like."""
    is_float = str(register.details.get("number_format", "")).startswith("F")
    return not is_float and not {"step", "offset"} & register.details.keys()


def _text(device: ImportedDevice, register: ImportedRegister, format: str, entry: Mapping[str, Any]) -> None:
    characters = whole(entry, "string_data_size", 1)
    if format != "char8" and "string_data_size" not in entry:
        register.gaps.append("string_data_size is not stated; 1 was assumed")
    register.details["length"] = characters if _TEXTS[format] else (characters + 1) // 2
    words_reversed, bytes_swapped = _is_little(entry, "word_order"), _is_little(entry, "byte_order")
    if words_reversed and register.details["length"] > 1:
        device.lose(register.name, "a text whose word_order is little_endian")
        return
    if bytes_swapped and _TEXTS[format]:
        device.lose(register.name, "a text of one character a register, in its high byte")
        return
    if order := _TEXTS[format] or ("BA" if bytes_swapped else ""):
        register.details["order"] = order
    device.add(register, is_text=True)


def _place(address: Any) -> tuple[int, tuple[int, int] | None]:
    """Split "register:shift:width" into the address and (shift, width).

    Without a shift, (shift, width) is None. Without a width, the width is 0.
    """
    register, *bits = str(address).split(":")
    at = whole({"address": register}, "address")
    if not bits:
        return at, None
    return at, (whole({"shift": bits[0]}, "shift"), whole({"width": bits[1]}, "width") if bits[1:] else 0)


def _is_little(entry: Mapping[str, Any], key: str) -> bool:
    given = str(entry.get(key, "big_endian"))
    if given not in _ORDERS:
        raise ValueError(f"{key} = {given[:40]!r} is not one of {', '.join(_ORDERS)}")
    return _ORDERS[given]
