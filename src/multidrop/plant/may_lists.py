"""May lists: registers and verbs that others may command, as `write` and `verbs` of a plant file say."""

from __future__ import annotations

from typing import Final

from multidrop.drive.named_verbs import verbs_of
from multidrop.plant.model import Plant
from multidrop.toml_check import Key

MAY_LISTS: Final = {
    "write": Key(list, 'write = ["pump-1.frequency_setpoint"]'),
    "verbs": Key(list, 'verbs = ["pump-1.start"]'),
}


def check_listed(plant: Plant, key: str, entry: object) -> bool:
    """Check an entry of a list: a register that can be written, or a verb that its drive has.

    `stop` is no verb of a list: it needs none. Returns True. Raises ValueError.
    """
    name, dot, rest = entry.rpartition(".") if isinstance(entry, str) else ("", "", "")
    if not dot:
        raise ValueError(f"{key}: {entry!r} is not right; write {MAY_LISTS[key].example}")
    try:
        _, drive = plant.find_drive(name)
    except ValueError as unknown:
        raise ValueError(f"{key}: {str(unknown).replace(f'{plant.path} has', 'there is')}") from None
    if key == "write":
        try:
            register = drive.register(rest)
        except ValueError as unknown:
            raise ValueError(f"{key}: {entry}: {unknown}") from None
        if not register.writable:
            raise ValueError(f"{key}: {entry} is never written: {register.never or 'it can only be read'}")
        return True
    listed = [verb for verb in verbs_of(drive) if verb != "stop"]
    if rest not in listed:
        known = ", ".join(listed) or "none"
        raise ValueError(f"{key}: {name} has no verb {rest!r} that a list allows; it has {known}")
    return True
