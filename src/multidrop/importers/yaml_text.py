"""Read YAML from unknown sources: only safe types, with limits of size, time and memory. Needs PyYAML."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from multidrop.extras import install_command

MOST_CHARACTERS = 1_000_000
MOST_NODES = 50_000  # limit of nodes; an alias counts as many nodes as it stands for


class YamlTag(str):
    """A value with a tag such as `!secret host`, as text. The real value is not in the file."""


def parse_yaml(text: str) -> Any:
    """Return the document. A value with a tag such as !secret becomes a `YamlTag`.

    Raises ImportError if PyYAML is missing, ValueError if the text is invalid or too long, or expands to too
    many nodes.
    """
    try:
        yaml: Any = import_module("yaml")
    except ImportError as failure:
        raise ImportError(f"YAML is read with PyYAML: {install_command('yaml')}") from failure
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"the file has more than {MOST_CHARACTERS} characters of YAML")

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Limits the number of nodes."""

        left = MOST_NODES

        def compose_node(self, parent: Any, index: Any) -> Any:
            is_alias = self.check_event(yaml.AliasEvent)
            node = super().compose_node(parent, index)
            self.left -= 1
            if is_alias:
                self.count_again(node)
            if self.left < 0:
                raise ValueError(
                    f"the file has more than {MOST_NODES} entries, if each alias is replaced by its entries"
                )
            return node

        def count_again(self, node: Any) -> None:
            """Count the nodes that an alias stands for, up to the limit."""
            pending = [node]
            while pending and self.left >= 0:
                self.left -= 1
                value = pending.pop().value
                if isinstance(value, list):
                    pending += [
                        each for pair in value for each in (pair if isinstance(pair, tuple) else (pair,))
                    ]

    Loader.add_multi_constructor("!", lambda loader, suffix, node: YamlTag(_spelt(suffix, node.value)))
    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as failure:
        raise ValueError(f"the file is not YAML: {' '.join(str(failure).split())[:300]}") from failure
    except RecursionError as failure:
        raise ValueError("the file is YAML that is nested too deeply") from failure


def _spelt(suffix: str, value: Any) -> str:
    return f"!{suffix} {value}"[:100] if isinstance(value, str) else f"!{suffix}"
