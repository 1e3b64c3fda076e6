"""The programs of ros2 run: help, refused words, Ctrl-C during imports, memory, and starts that fail."""

import gc
import platform
import signal
import weakref
from pathlib import Path
from typing import ClassVar

import pytest
import yaml
from python_process import run_python

from sq_perception.nodes import process
from sq_perception.nodes.executables import PROGRAMS


def run(name: str, *arguments: str, before: str = "", after: str = "", exit_code: int = 0) -> tuple[str, str]:
    """A program, as the script that pip makes for it starts it, with code before and after the import."""
    # Tests that run in the background of a shell inherit an ignored SIGINT.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += f"import sys; sys.argv[0] = '/somewhere/bin/{name}'\n{before}\n"
    code += f"from sq_perception.nodes.executables import {name}\n{after}\nsys.exit({name}())"
    done = run_python("-c", code, *arguments, code=exit_code)
    return done.stdout, done.stderr


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_tells_topics_and_parameters_without_ros(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said, errors = run(name, "--help", before="sys.modules['rclpy'] = None")
    assert errors == ""
    assert f"usage: ros2 run sq_perception {name}" in said
    assert "--params-file FILE" in said
    shipped = process.configuration_file(f"{name.replace('recover_cameras', 'recover_node')}.yaml").read_text()
    for parameter in yaml.safe_load(shipped)["/**"]["ros__parameters"]:
        assert f"\n    {parameter}: " in said


def test_a_word_that_is_not_for_ros_is_refused() -> None:
    """As by who forgets --ros-args: the parameter would have been ignored without a word."""
    _, errors = run("recover_node", "-p", "model:=mine.safetensors", exit_code=2)
    assert "unrecognized arguments: -p model:=mine.safetensors" in errors


@pytest.mark.parametrize("call", [["recover_node"], ["grasp_node"], ["recover_cameras", "front"]])
def test_without_rclpy_a_program_says_what_is_missing(call: list[str]) -> None:
    _, errors = run(*call, before="sys.modules['rclpy'] = None", exit_code=1)
    assert errors.count("\n") == 1, errors
    assert "needs ROS 2 in Python: pip install 'sq_perception[ros]'" in errors


def test_an_rclpy_that_cannot_be_imported_leaves_one_traceback(tmp_path: Path) -> None:
    """As one of another Python, whose compiled part is not found."""
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("raise ImportError('no compiled part')")
    _, errors = run("recover_node", before=f"sys.path[:0] = [{str(tmp_path)!r}]", exit_code=1)
    assert errors.count("Traceback") == 1, errors
    assert errors.endswith("ImportError: no compiled part\n")


INTERRUPT = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
DURING = f"""
class Hook:
    def find_spec(self, name, path=None, target=None):
        if name == "sq_perception.nodes.process":
            {INTERRUPT}
sys.meta_path.insert(0, Hook())
"""


@pytest.mark.parametrize("moment", [{"before": DURING}, {"after": INTERRUPT}], ids=["importing", "imported"])
def test_ctrl_c_before_the_start_leaves_no_traceback(moment: dict[str, str]) -> None:
    assert run("recover_node", **moment, exit_code=-signal.SIGINT) == ("", "")


def test_only_the_programs_give_ctrl_c_another_meaning() -> None:
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "import sq_perception.nodes.executables as e; print(signal.getsignal(signal.SIGINT).__name__)"
    assert run_python("-c", code).stdout == "default_int_handler\n"


def test_setup_installs_these_programs(repository: Path) -> None:
    assert {path.name for path in (repository / "resource" / "ros2_run").iterdir()} == set(PROGRAMS)


class Ring:
    """Refers to itself: only a collection can free it."""

    def __init__(self) -> None:
        self.itself = self


def test_what_is_kept_is_not_looked_at_until_it_is_released():
    ring = Ring()
    ghost = weakref.ref(ring)
    process.keep_objects()
    del ring
    gc.collect()
    assert ghost() is not None
    process.release_objects()
    assert ghost() is None


def test_of_a_node_that_cannot_be_made_nothing_is_left():
    class Half:
        destroyed: ClassVar[list[str]] = []

        def __init__(self, name: str) -> None:
            self.name = name
            raise ValueError("depth_min, depth_max: expected depth_min < depth_max")

        def destroy_node(self) -> None:
            self.destroyed.append(self.name)

    with pytest.raises(ValueError, match="depth_min < depth_max"):
        process.make(Half, "recover_node")
    assert Half.destroyed == ["recover_node"]


HEAPS = """
import ctypes, threading
from sq_perception.nodes import process
{first}
together = threading.Barrier(8)
def work():
    kept = []
    for _ in range(20):
        together.wait()
        kept.append(bytearray(50_000))
threads = [threading.Thread(target=work) for _ in range(8)]
for one in threads: one.start()
for one in threads: one.join()
c = ctypes.CDLL(None)
c.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(c.fdopen(1, b"w"))
c.malloc_info(0, out)
c.fflush(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries have other heaps")
def test_threads_share_heaps():
    def heaps(first: str) -> int:
        return run_python("-c", HEAPS.format(first=first)).stdout.count("<heap nr=")

    assert heaps("") > 2
    assert heaps("process.share_heaps()") == 2
