"""What ``import sq_perception`` offers: the names, their price, and the lines of the README that use them."""

from __future__ import annotations

import ast
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sq_perception
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera

_SNIPPET = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def offered_to_type_checkers() -> dict[str, str]:
    """Name and origin of everything that the package imports for mypy alone."""
    tree = ast.parse(Path(sq_perception.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    found = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        found.update({alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names})
    return found


@pytest.mark.parametrize("name", sorted(set(sq_perception.__all__) - {"__version__"}))
def test_every_name_is_what_type_checkers_take_it_for(name: str) -> None:
    value = getattr(sq_perception, name)
    module, _, there = offered_to_type_checkers()[name].rpartition(".")
    assert value is getattr(sys.modules[module], there)
    assert value.__doc__


def test_nothing_else_is_offered() -> None:
    assert set(offered_to_type_checkers()) | {"__version__"} == set(sq_perception.__all__)
    assert set(sq_perception.__all__) <= set(dir(sq_perception))
    with pytest.raises(AttributeError, match="no attribute 'Recoverers'"):
        _ = sq_perception.Recoverers


def test_every_name_is_in_the_reference(repository: Path) -> None:
    page = (repository / "docs" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: (\S+)$", page, re.MULTILINE))
    assert set(offered_to_type_checkers().values()) <= shown
    pytest.importorskip("sensor_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")
    for name in shown:
        pkgutil.resolve_name(name)


def test_names_are_loaded_when_they_are_used() -> None:
    """A clock would measure the machine: what takes time is counted instead."""
    code = (
        "import sys; before = set(sys.modules); import sq_perception\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)\n"
        "assert new == {'sq_perception'}, new\n"
        "sq_perception.Camera\n"
        "assert 'sq_perception.imaging.camera' in sys.modules\n"
        "assert not {'torch', 'numba', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "from sq_perception import *\n"
        "assert Recoverer.__module__ == 'sq_perception.recovery.recoverer'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


def snippets(page: Path) -> list[str]:
    return _SNIPPET.findall(page.read_text(encoding="utf-8"))


def test_the_script_of_the_readme_runs(repository: Path, tmp_path: Path) -> None:
    script = snippets(repository / "README.md")[0]
    camera = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    body = Superquadric([0.05, 0.04, 0.06], [0.2, 0.9], [0.0, 0.0, 0.5], [0.7, 0.1, 0.1, 0.7])
    depth, _ = raycast.render(body, camera)
    np.savez(tmp_path / "frame.npz", depth=np.where(np.isfinite(depth), depth, np.nan), K=camera.matrix)
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"(CONVERGED|WEAK): half sizes .* mm \+- .* mm at ", done.stdout), done.stdout
    assert (tmp_path / "frame.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "frame.glb").read_bytes()[:4] == b"glTF"
    assert len(script.splitlines()) <= 14


def test_the_reader_of_the_readme_runs(repository: Path) -> None:
    """Up to its spinning, which never ends."""
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    script = snippets(repository / "README.md")[1]
    code = f"import rclpy; rclpy.spin = lambda node: print(node.get_name())\n{script}\nprint(read.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    assert done.stdout.split() == ["reader", "read"]


def test_all_snippets_of_the_documents_are_python(repository: Path) -> None:
    for page in (repository / "README.md", *sorted((repository / "docs").glob("*.md"))):
        for text in snippets(page):
            compile(text, page.name, "exec")
