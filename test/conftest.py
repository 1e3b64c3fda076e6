"""What all tests share: the data beside the repository, the source tree, and a ROS domain of their own."""

import inspect
import os
import resource
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
import pytest

import sq_perception

REPOSITORY = Path(__file__).resolve().parent.parent
_STARTING = {
    *("subprocess", "browser", "python_process", "sealed_network"),
    *("started_nodes", "running_nodes", "respawned_nodes", "hostile_messages"),
}
"""Modules by which tests start processes."""


def pytest_configure(config: pytest.Config) -> None:
    """Keep test nodes, and the processes they start, away from whatever else runs on this machine."""
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # OpenMP's idle threads spin by default: beside other work, numba's and torch's keep each other from the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes, themselves, by their fixtures, or by a helper."""
    for item in items:
        if isinstance(item, pytest.Function):
            names = [*_names(inspect.unwrap(item.function).__code__), *item.fixturenames]
            if _starts_processes(names, vars(item.module), set()):
                item.add_marker(pytest.mark.process)


def _starts_processes(names: Iterable[str], module: dict[str, Any], seen: set[str]) -> bool:
    """Whether one of these names of a test module stands for, or uses, what starts processes."""
    for name in set(names) & module.keys() - seen:
        seen.add(name)
        value = inspect.unwrap(module[name]) if callable(module[name]) else module[name]
        if {getattr(value, "__name__", ""), getattr(value, "__module__", "")} & _STARTING:
            return True
        methods = vars(value).values() if inspect.isclass(value) else [value]
        codes = [method.__code__ for method in methods if hasattr(method, "__code__")]
        if any(_starts_processes(_names(code), module, seen) for code in codes):
            return True
    return False


def _names(code: CodeType) -> list[str]:
    """All names of a function that are not its own, with those of the functions in it."""
    inner = [name for each in code.co_consts if isinstance(each, CodeType) for name in _names(each)]
    return [*code.co_names, *inner]


@pytest.fixture(scope="session", autouse=True)
def _away_from_the_sources(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Processes that tests start import the package that the tests import.

    Python looks into the working directory first: `make test` begins in the source tree, whose kernels nobody compiled.
    """
    before, given = Path.cwd(), os.environ.get("PYTHONPATH")
    if Path(sq_perception.__file__).resolve().parents[1] == REPOSITORY:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(REPOSITORY), given]))
    os.chdir(tmp_path_factory.mktemp("away"))
    yield
    os.chdir(before)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The source tree that these tests lie in."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded frames; SQ_SHARED_DATA names another place.  Skips where there is none."""
    folder = Path(os.environ.get("SQ_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recorded frames: {folder} is missing (set SQ_SHARED_DATA)")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with the same numbers in every run."""
    return np.random.default_rng(20240607)


@pytest.fixture
def file_size_limit() -> Callable[[int], AbstractContextManager[None]]:
    """A context in which no file of this process can grow beyond so many bytes, as on a full disk."""

    @contextmanager
    def limited(most: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture(scope="session")
def source_copy(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the source tree, so that builds leave nothing in the tree itself."""
    target = tmp_path_factory.mktemp("source") / "sq_perception"
    hidden = (".git", ".venv*", ".*cache", ".hypothesis")
    generated = ("build", "install", "log", "dist", "site", "runs", "*.egg-info", "__pycache__", *hidden)
    shutil.copytree(repository, target, ignore=shutil.ignore_patterns(*generated))
    for made in ("demo.png", "demo.glb", "demo.json"):  # by `make demo`; the documents have pictures of that name
        (target / made).unlink(missing_ok=True)
    return target
