"""YAML as the native format uses it: plain data, numbers that every reader takes as numbers, errors that name the line."""

import math
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from camera_models.errors import InputError
from camera_models.formats.disk import read_text

# libyaml parses the same language several times faster where PyYAML was built with it.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

DEEPEST = 64
MOST_REPEATED = 100_000
"""Values that aliases may stand for, all together."""
_TIMESTAMP = "tag:yaml.org,2002:timestamp"
_FLOAT = "tag:yaml.org,2002:float"


class _Loader(_SafeLoader):
    """Refuses a key given twice (YAML 1.1 lets the last one win), takes 1e-6 for the number it is, leaves dates as text."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML reads it from the class)
        first: [(tag, pattern) for tag, pattern in resolvers if tag != _TIMESTAMP]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """The mapping of a node; raises ConstructorError for a key given twice."""
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key_node, yaml.ScalarNode) and key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' is given twice", key_node.start_mark)
            seen.add(key if isinstance(key_node, yaml.ScalarNode) else id(key_node))
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


# YAML 1.2 numbers that YAML 1.1, which PyYAML reads, takes for text: an exponent without a point or without a sign.
_Loader.add_implicit_resolver(_FLOAT, re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)$"), list("-+.0123456789"))


class _Dumper(yaml.SafeDumper):
    """Keys in the order given, lists of plain values on one line, no anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        return super().increase_indent(flow, False)


def _represent_list(dumper: _Dumper, items: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flat)


def _represent_text(dumper: _Dumper, text: str) -> yaml.Node:
    # Quoted are texts that some version of YAML would read as a number; escaped are the line breaks that only YAML knows.
    style = None if text.isprintable() else '"'
    if re.match(r"[-+.]?[0-9]", text) and not text[-1:].isalpha():
        style = style or "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(str, _represent_text)


def read_yaml(path: str | Path) -> Any:
    """The data of a YAML file; raises InputError naming the file, and the line where it is malformed. Empty documents, such as
    the one behind the last line of what `rostopic echo` prints, are passed over."""
    text = read_text(path)
    try:
        _check_nesting(text, path)
        documents = [data for data in yaml.load_all(text, Loader=_Loader) if data is not None]  # a subclass of the safe loader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        problem = error.problem or error.context
        raise InputError(f"{path}{line} is not valid YAML: {problem}; correct it or restore the file.") from None
    except yaml.reader.ReaderError as error:
        line_number = text.count("\n", 0, error.position) + 1
        raise InputError(f"{path}, line {line_number} holds a character that YAML forbids; remove it.") from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        if re.search(rf"[0-9_]{{{sys.get_int_max_str_digits()},}}", text):
            raise InputError(
                f"{path} was expected to hold numbers within reason, found one of thousands of digits; restore it."
            ) from None
        raise InputError(f"{path} is not valid YAML ({error}); correct it or restore the file.") from None
    if len(documents) > 1:
        raise InputError(f"{path} was expected to hold one document of YAML, found {len(documents)} set apart by ---; keep one.")
    return documents[0] if documents else None


def _check_nesting(text: str, path: str | Path) -> None:
    """Refuse, from the parser's events and without recursion, what is nested too deeply or grows too much by its aliases.

    libyaml's composer recurses for each level, and ends the process where the stack does; lists of aliases of lists of aliases
    take a minute to walk through for a few kilobytes.
    """
    sizes: dict[str | None, int] = {}
    open_nodes: list[list[Any]] = [[None, 0]]
    repeated = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in open_nodes):
                raise InputError(f"{path}: no value of YAML may hold itself, found that '{event.anchor}' does; restore the file.")
            repeated += sizes.get(event.anchor, 1)
            open_nodes[-1][1] += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append([event.anchor, 1])
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = open_nodes.pop()
            sizes |= {anchor: size} if anchor else {}
            open_nodes[-1][1] += size
        elif isinstance(event, yaml.ScalarEvent):
            sizes |= {event.anchor: 1} if event.anchor else {}
            open_nodes[-1][1] += 1
        if len(open_nodes) > DEEPEST + 1 or repeated > MOST_REPEATED:
            what = (
                f"nested more than {DEEPEST} deep" if len(open_nodes) > DEEPEST + 1 else "made of aliases that repeat each other"
            )
            raise InputError(f"{path} was expected to be a plain file of YAML, found one that is {what}; restore the file.")


def yaml_text(data: Mapping[str, Any]) -> str:
    """YAML of mappings, sequences, arrays, numbers, texts, booleans and None.

    Floats are the shortest text that reads back to the same double, with a point and a signed exponent (1.0e-06), as YAML 1.1
    wants them. Raises InputError where a number is NaN or infinite or a value is of another kind, naming where it stands.
    """
    return yaml.dump(
        _plain(data, ""), Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False, width=2**31 - 1
    )


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, str | Path):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise InputError(f"{where} is {value} where a file needs a finite number; leave it out (None) if it is not known.")
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}" if where else str(key)) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    raise InputError(f"{where} is a {type(value).__name__}, which a file cannot hold; give numbers, texts, lists or mappings.")
