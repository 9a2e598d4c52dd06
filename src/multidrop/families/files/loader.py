"""Load a family from a TOML file after checking the whole file. No code is run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from multidrop.drive.declaration_check import DeclarationError, declaration_errors, written_places
from multidrop.drive.family import TAKEN_NAMES, Drive
from multidrop.drive.register import Access, Register
from multidrop.families import MODELS
from multidrop.families.files import FamilyError
from multidrop.families.files.notation import Counting
from multidrop.families.files.registers import (
    MOST_BYTES,
    MOST_REGISTERS,
    Declared,
    beside,
    declare_rows,
    defaults_of,
    shown,
)
from multidrop.families.files.sections import (
    FAMILY_KEYS,
    facts_of,
    identify,
    options_of,
    parameter_space_of,
    proofs_of,
    texts_of,
)
from multidrop.printable import did_you_mean
from multidrop.toml_check import TomlPlace
from multidrop.toml_document import parse_document, read_bounded

SECTIONS = (
    "family",
    "default",
    *(access.value for access in Access),
    "text",
    "option",
    "parameters",
    "identify",
)
MOST_MISTAKES = 200
MOST_CSV_FILES = 20


# loaded families by path, each with the contents of its files, which show whether the files have changed
_loaded: dict[Path, tuple[Mapping[Path, bytes], type[Drive]]] = {}


def load_family(path: Path | str) -> type[Drive]:
    """Return the family that a TOML file declares: a subclass of `Drive`.

    Loading an unchanged file again returns the same class. The `model` is the file's name.
    Raises FamilyError that lists all mistakes in the file and in the CSV files that it names.
    """
    path = Path(path)
    place = TomlPlace.in_file(path)
    whole = path.resolve()
    if whole in _loaded:
        known, family = _loaded[whole]
        if all(_same(file, data) for file, data in known.items()):
            return family
    files: dict[Path, bytes] = {}
    data = place.attempt(_bytes, path, "family's file")
    document = None if data is None else place.attempt(parse_document, data)
    if data is None or document is None:
        raise FamilyError(tuple(place.config_errors))
    files[whole] = data
    made = _family(document, path, place, files)
    if made is None:
        raise FamilyError(_at_most(place))
    _loaded[whole] = files, made
    return made


def _same(file: Path, data: bytes) -> bool:
    try:
        return _bytes(file, "family's file") == data
    except ValueError:
        return False


def _bytes(path: Path, what: str) -> bytes:
    """Return a file's bytes. Raises ValueError if the file is missing or too long; the error has no path."""
    try:
        if not path.is_file():
            other = "is not a file, but a directory or a device; name a file" if path.exists() else ""
            raise ValueError(other or "there is no such file")
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    return read_bounded(path, MOST_BYTES, what)


def _at_most(place: TomlPlace) -> tuple[str, ...]:
    left = len(place.config_errors) - MOST_MISTAKES
    if left > 0:
        del place.config_errors[MOST_MISTAKES:]
        place.wrong(f"{left} more mistakes are not shown; correct these first")
    return tuple(place.config_errors)


# ---- the document ----


def _family(
    document: Mapping[str, Any], path: Path, place: TomlPlace, files: dict[Path, bytes]
) -> type[Drive] | None:
    """Return the class that the document declares; None if it has a mistake."""
    if "line" in document:
        place.wrong(
            "is a plant file, not a family file; to name one of its drives, write PLANT.toml DRIVE", "line"
        )
        return None
    _check_sections(document, place)
    of_family = place.within("[family]", "family")
    of_document = document.get("family", {})
    given = of_family.check(of_document, FAMILY_KEYS)
    counting = Counting(_counts_from(given, of_family))
    facts = facts_of(given, counting, of_family)
    defaults = defaults_of(document.get("default", {}), place.within("[default]", "default"))
    declared = Declared(counting, defaults, given.get("write", "single"))
    for access in Access:
        declared.section(access, document.get(access.value, {}), place)
    _add_csv(given.get("registers", []), declared, path, of_family, files)
    if counting.assumed and isinstance(of_document, dict) and "counts_from" not in of_document:
        of_family.wrong(
            f"'counts_from' is missing, so the number {shown(counting.assumed[0])} is ambiguous. Add "
            "counts_from = 0 if the manual's numbers are sent unchanged, or 1 if its register 1 is sent as 0"
        )
    texts = texts_of(document.get("text", {}), counting, declared.places, place)
    options = options_of(document.get("option", {}), declared.places, place)
    if not declared.places and not document.get("text") and not given.get("registers"):
        place.wrong("declares no register; add [reading] and NAME = { at = 0x0010 }")
    if len(declared.places) > MOST_REGISTERS:
        place.wrong(f"declares more than {MOST_REGISTERS} registers; remove unused ones")
        return None
    base = _base(given, of_family)
    _check_inherited(base, document, declared, texts, place)
    namespace: dict[str, Any] = {
        "__module__": __name__,
        "model": path.name,
        "declared_in": path.name,
        "options": {**base.options, **options},
        "broadcasts": base.broadcasts or any(one.broadcast for one in declared.registers.values()),
        **facts,
        **declared.registers,
        **texts,
    }
    if "parameters" in document:
        rule = parameter_space_of(document["parameters"], counting, declared.places, place)
        namespace["parameter_space"] = rule
    if "identify" in document:
        namespace["identity_proofs"] = proofs_of(document["identify"], declared.registers, place)
        if base.identify is Drive.identify:
            namespace["identify"] = identify
    return _made(base, namespace, declared, place)


def _base(given: Mapping[str, Any], place: TomlPlace) -> type[Drive]:
    """Return the base class that the family extends: a profile, a built-in family, or Drive."""
    if "profile" in given and "extends" in given:
        place.wrong("has the keys profile and extends; remove one of them")
    for key in ("profile", "extends"):
        if key in given:
            classes = bases(key)
            if given[key] in classes:
                return classes[given[key]]
            place.wrong(f"{key} = {shown(given[key])} is not known; {did_you_mean(given[key], classes)}")
    return Drive


def _check_inherited(
    base: type[Drive], document: Mapping[str, Any], declared: Declared, texts: Iterable[str], place: TomlPlace
) -> None:
    """Report declarations whose name, address or section the extended built-in family already has.

    They would replace parts of the family, such as a limit, or a check that prevents a start of the motor.
    """
    if base not in MODELS.values():
        return
    own = {name for name in (*declared.places, *texts) if name not in TAKEN_NAMES}
    taken = [name for name in own if hasattr(base, name)]
    _report([f"{name}: {base.title} has this name already; rename it" for name in taken], declared, place)
    others = {name: one for name, one in declared.registers.items() if name not in taken}
    _report(_inherited_errors(others, base.registers, base.title), declared, place)
    if "parameters" in document and base.parameter_space is not None:
        place.within("[parameters]", "parameters").wrong(
            f"{base.title} has its own rule for parameters; remove this section"
        )
    if "identify" in document and base.identify is not Drive.identify:
        place.within("[[identify]]", "identify").wrong(
            f"{base.title} has its own identity check; remove this section"
        )


def _inherited_errors(
    registers: Mapping[str, Register[Any]], inherited: Mapping[str, Register[Any]], title: str
) -> Iterator[str]:
    """Yield an error sentence for each register that writes to the address of an inherited register.

    Writes of such a register would bypass the limits of the inherited one. `title` names the extended family.
    """
    owners = {place: one for one in inherited.values() for place in written_places(one)}
    for register in registers.values():
        found = next((owners[place] for place in written_places(register) if place in owners), None)
        if found is not None:
            yield (
                f"{register.name}: {title} has {found.name} at this address, with its own limits; leave it "
                "out, or declare a reading"
            )


def bases(key: str) -> Mapping[str, type[Drive]]:
    """Return the base classes, by name, that the key "profile" or "extends" can name."""
    if key == "extends":
        return MODELS
    from multidrop.families.profiles import PROFILES  # imported only for the few files with a profile

    return PROFILES


def _check_sections(document: Mapping[str, Any], place: TomlPlace) -> None:
    sections = dict.fromkeys(SECTIONS)
    if "verb" in document:
        place.wrong(
            "[verb] is not supported; add profile to [family], or write the drive as a Python class", "verb"
        )
        document = {name: table for name, table in document.items() if name != "verb"}
    if unknown := {name: None for name in document if name not in SECTIONS}:
        place.unknown(unknown, sections)
    if "family" not in document:
        place.wrong("has no [family]; add it, with the title and the manual")


def _counts_from(given: Mapping[str, Any], place: TomlPlace) -> int | None:
    number = given.get("counts_from")
    if number not in (None, 0, 1):
        place.wrong(f"counts_from = {number} is not right; write {FAMILY_KEYS['counts_from'].example}")
        return None
    return number


def _add_csv(
    names: list[Any], declared: Declared, path: Path, place: TomlPlace, files: dict[Path, bytes]
) -> None:
    if len(names) > MOST_CSV_FILES:
        place.wrong(f"registers names {len(names)} files, more than the allowed {MOST_CSV_FILES}")
        return
    for name in names:
        table = place.attempt(beside, path, name)
        data = None if table is None else place.attempt(_named_bytes, table)
        if table is not None and data is not None:
            files[table.resolve()] = data
            declare_rows(data, declared, place.of_file(table))


def _named_bytes(table: Path) -> bytes:
    try:
        return _bytes(table, "table of registers")
    except ValueError as mistake:
        raise ValueError(f'registers = ["{table.name}"]: {mistake}') from None


# ---- the class ----


def _made(
    base: type[Drive], namespace: dict[str, Any], declared: Declared, place: TomlPlace
) -> type[Drive] | None:
    """Create the class with this namespace; return None if the class has a mistake."""
    broken = declared.places.keys() - declared.registers.keys()
    if place.config_errors:
        bounds = {*namespace["options"], *broken}
        _report(declaration_errors(declared.registers, TAKEN_NAMES, bounds), declared, place)
        roles = getattr(base, "role_mistakes", None)
        mistakes = roles(declared.registers) if roles else []
        _report([one for one in mistakes if one.partition(":")[0] not in broken], declared, place)
        return None
    try:
        return type(_class_name(place.path), (base,), namespace)
    except DeclarationError as wrong:
        _report(wrong.mistakes, declared, place)
        return None


def _report(mistakes: Any, declared: Declared, place: TomlPlace) -> None:
    """Report mistakes in declarations, each with the place of its register in the file."""
    for mistake in mistakes:
        name, _, sentence = mistake.partition(": ")
        if name in declared.places:
            declared.places[name].wrong(sentence)
        else:
            place.within("[family]", "family").wrong(mistake)


def _class_name(path: Path) -> str:
    name = "".join(word.capitalize() for word in re.findall(r"[A-Za-z0-9]+", path.stem))
    return name if name[:1].isalpha() else f"Family{name}"
