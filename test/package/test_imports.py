"""The house rules: imports run one way, and importing does nothing but import."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from python_process import run_python

import sq_msgs_py
import sq_perception

PERCEPTION = Path(sq_perception.__file__).parent
MESSAGES = Path(sq_msgs_py.__file__).parent
PACKAGES = (PERCEPTION, MESSAGES)

# From the lowest up; a module may import from its own layer and from those below it.
LAYERS = (
    ("geometry", "files"),
    ("imaging", "tracking"),
    ("segmentation", "simulation"),
    ("learning", "fitting", "grasping"),
    ("recovery",),
    ("recordings",),
    ("evaluation",),
    ("nodes",),
    ("commands",),
)
ROS = ("rclpy", "sensor_msgs", "std_msgs", "std_srvs", "visualization_msgs", "diagnostic_msgs", "geometry_msgs",
       "rcl_interfaces", "lifecycle_msgs", "builtin_interfaces", "shape_msgs", "tf2_ros", "tf2_msgs", "vision_msgs",
       "moveit_msgs")  # fmt: skip


def imports(path: Path, with_types: bool = True) -> Iterator[tuple[str, bool]]:
    """Full names a file imports, wherever in it, and whether the statement runs when the module is imported.

    Without ``with_types`` those are left out that only a type checker sees.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if not with_types:
        tree.body = [
            node for node in tree.body if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))
        ]
    inner = {node for scope in ast.walk(tree) if isinstance(scope, ast.FunctionDef) for node in ast.walk(scope)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node not in inner
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node not in inner


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name, _ in imports(path)}


def is_node(path: Path) -> bool:
    return (PERCEPTION / "nodes") in path.parents


def subpackage(name: str) -> str:
    """The module or subpackage of sq_perception that a dotted name leads into; '' for the package itself."""
    parts = name.split(".")
    if parts[0] != "sq_perception" or len(parts) == 1:
        return ""
    return parts[1]


def layer(name: str) -> int:
    found = [k for k, names in enumerate(LAYERS) if name in names]
    assert len(found) == 1, f"{name} has no layer"
    return found[0]


def test_imports_run_one_way() -> None:
    guilty = []
    for path in PERCEPTION.rglob("*.py"):
        here = path.relative_to(PERCEPTION).with_suffix("").parts[0]
        if here not in ("__init__", "__main__"):
            below = {name for names in LAYERS[: layer(here) + 1] for name in names}
            inner = {subpackage(name) for name, _ in imports(path) if name.split(".")[0] == "sq_perception"}
            guilty += [f"{path.name} imports {name}" for name in inner - below]
    assert guilty == []


def test_only_nodes_know_ros_and_only_the_demo_runs_nodes() -> None:
    guilty = [path for path in PERCEPTION.rglob("*.py") if not is_node(path) and roots(path) & set(ROS)]
    assert guilty == []
    others = [path for path in PERCEPTION.rglob("*.py") if not is_node(path)]
    importing = {path for path in others if any(subpackage(name) == "nodes" for name, _ in imports(path))}
    assert importing == {PERCEPTION / "commands" / "demo.py"}


def test_only_nodes_bags_and_calibrations_join_the_two_packages() -> None:
    """What a recorded message says is decoded by the code that decodes a live one; that needs no ROS."""
    joining = {path for path in PERCEPTION.rglob("*.py") if not is_node(path) and "sq_msgs_py" in roots(path)}
    names = ("bag_file", "result_bag", "publication", "scene_export")
    assert joining == {PERCEPTION / "imaging/calibration.py", *(PERCEPTION / f"recordings/{name}.py" for name in names)}
    absent = f"import sys; sys.modules.update(dict.fromkeys({ROS!r}))"
    modules = loaded_after(f"{absent}; import sq_perception.recordings.inputs, sq_perception.recordings.scene_export")
    assert "sq_msgs_py.depth_image" in modules
    assert not modules & {"rosbags", "torch"}
    modules = loaded_after(
        f"{absent}; import sq_perception.recordings.result_bag, sq_msgs_py.superquadrics, sq_msgs_py.markers"
    )
    assert "mcap" in modules


def test_messages_need_numpy_and_messages_only() -> None:
    allowed = {"sq_msgs_py", "numpy", "sensor_msgs", "std_msgs", "geometry_msgs", "shape_msgs", "visualization_msgs"}
    soft = {"vision_msgs", "moveit_msgs"}
    found = set().union(*(roots(path) for path in MESSAGES.rglob("*.py")))
    assert found - set(sys.stdlib_module_names) <= allowed | soft


def test_a_consumer_loads_neither_the_package_nor_messages_that_a_robot_may_lack() -> None:
    pytest.importorskip("shape_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")
    absent = "import sys; sys.modules.update(dict.fromkeys(('vision_msgs', 'moveit_msgs', 'tf2_msgs', 'tf2_ros')))"
    names = ("poses", "collision_objects", "depth_image", "superquadrics", "markers")
    modules = loaded_after("; ".join([absent, *(f"import sq_msgs_py.{name}" for name in names)]))
    assert {"numpy", "sq_msgs_py.shapes"} <= modules
    assert not modules & {"torch", "sq_perception", "scipy", "cv2", "numba", "rclpy"}


def test_no_module_waits_for_itself() -> None:
    """No circle of modules, imports inside functions included; those for type checkers alone do not count."""
    modules = {
        ".".join(path.relative_to(PERCEPTION.parent).with_suffix("").parts): path for path in PERCEPTION.rglob("*.py")
    }
    needs = {}
    for module, path in modules.items():
        named = {name for name, _ in imports(path, with_types=False)}
        needs[module] = {name if name in modules else name.rpartition(".")[0] for name in named} & modules.keys() - {
            module
        }
    while free := {module for module, others in needs.items() if not others & needs.keys()}:
        needs = {module: others for module, others in needs.items() if module not in free}
    assert not needs


def test_nothing_dangerous_is_called() -> None:
    """No code from data: pickle, torch.load, eval, exec, a YAML loader that builds objects, a shell."""
    dangerous = {"eval", "exec", "torch.load", "yaml.load", "yaml.unsafe_load", "os.system"}
    for path in (path for package in PACKAGES for path in package.rglob("*.py")):
        assert not roots(path) & {"pickle", "marshal", "shelve"}, path
        calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
        for node in calls:
            assert ast.unparse(node.func) not in dangerous, f"{path}: {ast.unparse(node)}"
            for keyword in node.keywords:
                is_true = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
                assert not (keyword.arg in ("shell", "allow_pickle") and is_true), f"{path}: {ast.unparse(node)}"


def loaded_after(statement: str) -> set[str]:
    """Names of the modules that a fresh interpreter holds after a statement; it must not print anything itself."""
    places = [str(package.parent) for package in PACKAGES]
    code = f"import sys; sys.path[:1] = {places!r}; {statement}; print(*sorted(sys.modules))"
    said = run_python("-c", code).stdout
    assert said.count("\n") == 1, said
    return set(said.split())


def test_recovery_neither_trains_nor_draws_reads_no_weights_and_knows_no_ros() -> None:
    statement = (
        "opened = []; sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == 'open' else None); "
        "import sq_perception.recovery.recoverer; "
        "assert opened and not any(name.endswith('.safetensors') for name in opened)"
    )
    modules = loaded_after(statement)
    assert "numba" in modules
    forbidden = {"sq_perception.learning.train", "sq_perception.learning.dataset", "rclpy", "sensor_msgs", "sq_msgs_py"}
    assert not modules & (forbidden | {"torch", "matplotlib", "trimesh"})


def test_a_node_that_starts_again_waits_for_nothing_that_it_does_not_need() -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    modules = loaded_after("import sq_perception.nodes.frame_node")
    assert "numba" in modules
    # numba loads scipy.linalg.
    assert not modules & {"torch", "scipy.special", "scipy.spatial", "scipy.optimize", "trimesh", "matplotlib", "rich"}
