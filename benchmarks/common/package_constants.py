"""The numeric constants of rooms of the package: which there are, what reads them, and how they get other values.

Constants are the numbers that modules name in capitals, and the defaults of their options.  Compiled code that reads
one has it frozen in.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import math
import pkgutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

FIXED = {
    "STEP_LENGTH": "a number of parameters",
    "LENGTH": "a number of parameters",
    "EXACT": "a number of forms",
    "LANES": "a length of vectors",
    "RAY_COLUMNS": "a number of columns",
    "ROWS": "a number of rows",
    "_ROWS": "a number of rows",
    "MEDIAN_TO_SIGMA": "of the normal distribution",
    "EIGHTH_TURNS": "turns by an angle of symmetry",
    "CLASSIC": "a name",
    "SAMPSON": "a name",
    "RENDERED": "a name",
    "FIRST_FAILED_ID": "a name",
    "TURNS": "turns of a cube",
    "_QUATERNIONS": "turns of a cube",
    "_CHANGES": "turns of a cube",
    "_DIRECTIONS": "directions of a cube",
}
"""Numbers that cannot be varied."""


@dataclass(frozen=True)
class Constant:
    """A number of a module, or a default of one of its options."""

    room: str
    module: str
    name: str
    field: str = ""

    @property
    def key(self) -> str:
        return f"{self.room}.{self.module}.{self.name}" + (f".{self.field}" if self.field else "")

    @property
    def home(self) -> ModuleType:
        return importlib.import_module(f"sq_perception.{self.room}.{self.module}")

    @property
    def value(self) -> Any:
        holder = getattr(self.home, self.name)
        return getattr(holder, self.field) if self.field else holder

    def set(self, value: Any) -> None:
        """For all that read it from now on."""
        if self.field:
            holder = getattr(self.home, self.name)
            holder.__init__.__kwdefaults__[self.field] = value
            setattr(holder, self.field, value)
            return
        before = self.value
        for module in _modules():
            if module is self.home or (self.name in _imported(module, self.home.__name__)):
                assert getattr(module, self.name) is before
                setattr(module, self.name, value)


def constants(room: str) -> Iterator[Constant]:
    """Those of a room, module by module."""
    folder = importlib.import_module(f"sq_perception.{room}")
    for module in sorted(each.name for each in pkgutil.iter_modules(folder.__path__)):
        home = importlib.import_module(f"sq_perception.{room}.{module}")
        for node in _tree(home).body:
            if isinstance(node, ast.Assign) and not ast.unparse(node.value).startswith("range"):
                for name in [each.id for each in ast.walk(node.targets[0]) if isinstance(each, ast.Name)]:
                    if name.strip("_").isupper() and _is_number(getattr(home, name)):
                        yield Constant(room, module, name)
            if isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
                for each in dataclasses.fields(getattr(home, node.name)):
                    if _is_number(each.default):
                        yield Constant(room, module, node.name, each.name)


def varied(value: Any, factor: float) -> Any:
    """The constant multiplied; whole numbers by at least one."""
    if isinstance(value, tuple):
        return tuple(varied(each, factor) for each in value)
    if isinstance(value, float) and 0.9 < value < 1:
        return 1 - (1 - value) / factor
    if isinstance(value, int):
        return max(0, min(round(factor * value), value - 1) if factor < 1 else max(round(factor * value), value + 1))
    return factor * value


def reason_to_pass(constant: Constant, kernels: bool) -> str:
    """Why it is not varied; empty if it is."""
    if constant.name in FIXED:
        return FIXED[constant.name]
    if constant.field:
        return ""
    if _read_when_loaded(constant.home, constant.name):
        return "read when its module is loaded"
    if not kernels and frozen_in(constant):
        return "compiled in"
    return ""


@cache
def _modules() -> tuple[ModuleType, ...]:
    return tuple(module for name, module in sys.modules.items() if name.startswith("sq_perception.") and module)


@cache
def _tree(module: ModuleType) -> ast.Module:
    assert module.__file__ is not None
    with open(module.__file__, encoding="utf-8") as file:
        return ast.parse(file.read())


@cache
def _imported(module: ModuleType, home: str) -> frozenset[str]:
    """The names that a module imports from another one."""
    found = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom) and node.module == home]
    return frozenset(alias.name for node in found for alias in node.names)


def _read_when_loaded(home: ModuleType, name: str) -> bool:
    """Whether a module uses its constant outside of functions."""

    def outside(node: ast.AST) -> Iterator[ast.AST]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.Lambda)):
                yield from (part for default in child.args.defaults for part in ast.walk(default))
            else:
                yield child
                yield from outside(child)

    return any(isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Load) for n in outside(_tree(home)))


@cache
def _dispatchers() -> frozenset[Dispatcher]:
    return frozenset(one for module in _modules() for one in vars(module).values() if isinstance(one, Dispatcher))


@cache
def _called_by(kernel: Dispatcher) -> frozenset[Dispatcher]:
    known = kernel.py_func.__globals__
    called = (known.get(name) for name in kernel.py_func.__code__.co_names)
    return frozenset(one for one in called if isinstance(one, Dispatcher))


def frozen_in(constant: Constant) -> set[Dispatcher]:
    """Compiled functions that read a constant, and those that call these."""
    homes = [constant.home.__name__]
    homes += [one.__name__ for one in _modules() if constant.name in _imported(one, constant.home.__name__)]
    near = [one for one in _dispatchers() if one.py_func.__module__ in homes]
    found = {one for one in near if constant.name in one.py_func.__code__.co_names}
    while True:
        callers = {one for one in _dispatchers() if found & _called_by(one)}
        if callers <= found:
            return found
        found |= callers


def forget(kernels: set[Dispatcher]) -> None:
    """Compile these anew when they are called next; nothing is read from or written to the disk."""
    for one in kernels:
        one._make_finalizer()()
        one._reset_overloads()
        one._cache = NullCache()


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(map(_is_number, value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "f"
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value != 0
