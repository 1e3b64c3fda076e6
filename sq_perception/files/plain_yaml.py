"""YAML files from outside: plain data only, bounded before it is read.

PyYAML's safe loader makes no objects, but a file of a few hundred bytes can still unfold into more text than any memory
holds (aliases), or nest deeper than the interpreter's stack.  Such files are refused here; no camera_info, bag or
configuration has either.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

LARGEST = 2**20
"""Bytes of a file."""
DEEPEST = 32
"""Levels of mappings and lists within each other."""


class YamlError(ValueError):
    """A file that cannot be read, or is no plain YAML; the message has the reason."""


def read_all(path: Path) -> list[Any]:
    """The documents of a file.

    Raises
    ------
    YamlError
        If it is missing, too large, not UTF-8, or no plain YAML.
    """
    try:
        with path.open("rb") as file:
            return documents(file.read(LARGEST + 1))
    except OSError as error:
        raise YamlError(str(error)) from error


def documents(data: bytes) -> list[Any]:
    """The documents of a file's bytes.  Raises YamlError as :func:`read_all` does."""
    if len(data) > LARGEST:
        raise YamlError(f"expected at most {LARGEST} bytes")
    try:
        text, depth = data.decode("utf-8"), 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                raise YamlError("expected plain data, got an alias (*)")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                raise YamlError(f"expected at most {DEEPEST} levels of nesting")
        return list(yaml.safe_load_all(text))
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, YamlError):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise YamlError(f"not YAML: {reason}" if isinstance(error, yaml.YAMLError) else reason) from error


def read(path: Path) -> Any:
    """The one document of a file; None if it is empty.  Raises YamlError as :func:`read_all` does."""
    documents = read_all(path)
    if len(documents) > 1:
        raise YamlError(f"expected one document, got {len(documents)}")
    return documents[0] if documents else None
