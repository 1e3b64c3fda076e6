"""A read-only installation of a user without a home starts, and keeps its kernels where nobody else can write."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from python_process import run_python

import sq_perception
from sq_perception.commands.installation import steps
from sq_perception.geometry import kernel_cache, kernels

READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,bind,ro "$0" && exec "$@"'
CODE = """
from sq_perception.geometry import kernels
value = kernels.gauge(0.1, 0.0, 0.0, 0.1, 0.1, 0.1, 1.0, 1.0, 0.0, 0.0)
print(kernels.__file__, round(value, 9), len(kernels.gauge.stats.cache_hits))
"""


def test_kernels_are_compiled_in_one_place() -> None:
    """So that what is tested here holds for all of them."""
    package = Path(sq_perception.__file__).parent
    guilty = [path for path in package.rglob("*.py") if "njit(" in path.read_text(encoding="utf-8")]
    assert guilty == [package / "geometry" / "kernel_cache.py"]


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package; skips where a folder cannot be made read-only for root too."""
    folder = tmp_path_factory.mktemp("installation")
    mount = ["unshare", "-rm", "sh", "-ec", READ_ONLY, str(folder), "true"]
    if not shutil.which("unshare") or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no mounts of one's own: unshare -rm is missing or not permitted")
    source = Path(sq_perception.__file__).parent
    shutil.copytree(source, folder / source.name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def run(installation: Path, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """The code in a process that can write neither to the package nor to a home."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_CACHE", "XDG_"))}
    places = {"HOME": "/proc/nobody", "PYTHONPATH": str(installation), "TMPDIR": str(folder)}
    command = ["unshare", "-rm", "sh", "-ec", READ_ONLY, str(installation), sys.executable, "-c", CODE]
    environment = {**kept, **places, **more}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=True, cwd=folder)


def test_it_starts_and_starts_again_with_what_it_compiled(installation: Path, tmp_path: Path) -> None:
    file = installation / "sq_perception" / "geometry" / "kernels.py"
    first, second = run(installation, tmp_path), run(installation, tmp_path)
    assert first.stdout.split() == [str(file), "1.0", "0"]
    assert second.stdout.split() == [str(file), "1.0", "1"]
    kept, compiling = first.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in kept
    assert compiling.startswith("compiling, once"), "a script without any logging set up is told too"
    assert second.stderr.splitlines() == [kept]
    (folder,) = tmp_path.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_command_that_has_to_compile_says_so_once(tmp_path: Path) -> None:
    """A first start takes minutes; a second one has nothing to compile."""
    body = "0.25 0.15 0.1 0.2 0.8 0.5 0.5 0.5 0 0 0 1"
    render = ["render", *body.split(" "), "--output", str(tmp_path / "view.png")]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    for times in (1, 0):
        done = run_python("-m", "sq_perception", *render, env=environment, cwd=tmp_path)
        assert done.stderr.count("compiling") == done.stderr.count("\n") == times


def test_a_folder_that_others_can_write_is_not_read(installation: Path, tmp_path: Path) -> None:
    """Whoever may write there can run code."""
    uid = 0  # unshare -r
    (tmp_path / f"sq_perception-kernels-{uid}").mkdir()
    (tmp_path / f"sq_perception-kernels-{uid}").chmod(0o777)
    assert "expected a folder of this user alone" in run(installation, tmp_path).stderr
    assert not list((tmp_path / f"sq_perception-kernels-{uid}").iterdir())


def test_a_named_place_goes_first(installation: Path, tmp_path: Path) -> None:
    assert "kept in" not in run(installation, tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "named")).stderr
    assert [path.name for path in tmp_path.iterdir()] == ["named"]


def test_a_named_place_that_cannot_be_written_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = run_python("-m", "sq_perception", "doctor", env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "file")})
    assert done.stderr.count("\n") == 1
    assert f"NUMBA_CACHE_DIR: {tmp_path / 'file'} cannot be written" in done.stderr


def test_the_name_of_a_kernel_follows_what_its_module_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Machine code is compiled again after a change of what was compiled into it, and after no other."""
    package = tmp_path / "sq_perception"
    imported = "from sq_perception.fitting import terms\nfrom sq_perception.geometry.ray import (\n    meet,\n)\n"
    sources = {"fitting/residuals.py": imported, "fitting/terms.py": "HUBER = 3.0\n"}
    sources |= {"geometry/ray.py": "from sq_perception.fitting import residuals\n", "geometry/mesh.py": ""}
    for name, text in sources.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    monkeypatch.setattr(kernels, "_ROOT", package)
    kept = {}
    for name in [*sources, ""]:
        if name:
            (package / name).write_text(sources[name] + "# changed\n")
        kernels._fingerprint.cache_clear()
        kernels._find_imports.cache_clear()
        kept[name] = kernels._fingerprint(package / "fitting" / "residuals.py")
    assert kept["geometry/mesh.py"] == kept[""] == kept["geometry/ray.py"]
    assert len({kept[name] for name in ("fitting/residuals.py", "fitting/terms.py", "geometry/ray.py")}) == 3


@pytest.mark.parametrize(("cores", "count"), [({0, 1}, 1), ({0}, 0)])
def test_a_second_process_compiles_beside_a_command_where_there_is_a_core(monkeypatch, cores, count):
    started: list[list[str]] = []
    monkeypatch.setattr(kernel_cache.subprocess, "Popen", lambda command, **_: started.append(command))
    monkeypatch.setattr(kernel_cache.os, "sched_getaffinity", lambda _: cores)
    monkeypatch.setattr(kernel_cache, "_is_shared", False)
    kernel_cache._announce.__wrapped__()
    assert not started, "a script compiles by itself"
    kernel_cache.compile_beside()
    kernel_cache._announce.__wrapped__()
    assert len(started) == count
    names = [name for name, _ in steps()]
    assert all(set(command[5:]) <= set(names) for command in started)
