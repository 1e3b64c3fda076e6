"""sq-perception doctor says what is there; warm-up compiles all that frames call, so that no camera waits for it."""

import os
import sys

import numpy as np
import trimesh
from numba.core.dispatcher import Dispatcher
from python_process import run_python

from sq_perception import Camera, Recoverer, __version__, fit_mesh, fit_points
from sq_perception.commands import installation, main
from sq_perception.fitting import levenberg_marquardt, point_cost
from sq_perception.fitting.decomposition import decompose
from sq_perception.simulation.scenes import TABLE_CAMERA, draw_crowd, table_scene


def test_the_doctor_names_versions_cores_weights_and_kernels(capsys):
    assert main.main(["doctor"]) == 0
    said = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    assert __version__ in said["program"]
    assert said["cores"].startswith(f"{len(os.sched_getaffinity(0))} of ")
    assert {"numpy", "[bags]", "[exr]", "[train]", "[ros]", "kernels"} <= said.keys()
    assert "robust" in said["weights"]


def test_what_is_missing_comes_with_its_remedy(monkeypatch, capsys):
    monkeypatch.setattr(installation, "_EXTRAS", {"bags": ("no_such_module",)})
    monkeypatch.setattr(installation, "_requirements", lambda: ["no-such-package>=3"])
    assert main.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "missing no_such_module: pip install 'sq_perception[bags]'" in said
    assert "missing: pip install 'no-such-package>=3'" in said


def test_sources_without_their_requirements_are_a_fault():
    """Run from a checkout nothing says what is required, but the kernels cannot be loaded."""
    code = "import sys; sys.modules['numba'] = None; from sq_perception.commands.installation import doctor; "
    code += "sys.exit(doctor([]))"
    assert "cannot be loaded: " in run_python("-c", code, code=1).stdout


def test_kernels_of_other_sources_are_told_from_none(tmp_path):
    """As after an update, whose digest is another one, and after an edit, which is younger than the code."""
    code = """
import os
from pathlib import Path
from sq_perception.commands import installation
from sq_perception.geometry import kernels
said = [installation._kernels()[0]]
kernels.gauge(0.1, 0.0, 0.0, 0.1, 0.1, 0.1, 1.0, 1.0, 0.0, 0.0)
said += [installation._kernels()[0]]
(file,) = Path(kernels.gauge.stats.cache_path).glob("*.gauge_*.nbi")
os.utime(file, (0, 0))
said += [installation._kernels()[0]]
file.rename(file.with_name("kernels.gauge_0123456789ab-1.nbi"))
print(*said, installation._kernels()[0], sep="\\n")
"""
    done = run_python("-c", code, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)})
    told = [line.partition(str(tmp_path))[0].strip() for line in done.stdout.splitlines()]
    other = "compiled for other sources: sq-perception warm-up; they go to"
    assert told == [other.replace("compiled for other sources", "not compiled yet"), "compiled, in", other, other]


def compiled() -> dict[str, set[object]]:
    """The kernels of this package that are loaded, and for what arguments."""
    return {
        f"{name}.{kernel.__name__}": set(kernel.signatures)
        for name, module in tuple(sys.modules.items())
        for kernel in vars(module).values()
        if name.startswith("sq_perception") and isinstance(kernel, Dispatcher)
    }


def test_frames_call_no_kernel_that_the_warm_up_did_not_compile() -> None:
    for _, step in installation.steps():
        step()
    known = compiled()
    assert len(known) > 100
    recoverer = Recoverer()
    for seed, width, count in ((1, 160, 2), (2, 320, 3)):
        camera = Camera(width, 3 * width // 4, width, width, width / 2 - 0.5, 3 * width / 8 - 0.5)
        depth, labels = table_scene(np.random.default_rng(seed), count, camera).render()
        recoverer.recover(depth.astype(np.float32), camera)
        recoverer.recover(depth, camera, labels)
        assert recoverer.recover(depth.astype(np.float32), camera).bodies
        depth[:, 1 : camera.width : 8] = np.nan  # as sensors have holes
        assert recoverer.recover(depth, camera).bodies
    touching, _ = draw_crowd(np.random.default_rng(1), 6, TABLE_CAMERA).render()
    assert recoverer.recover(touching.astype(np.float32), TABLE_CAMERA).bodies
    assert {name: new for name, of in compiled().items() if (new := of - known.get(name, set()))} == {}
    # One form of arguments, whatever array a hull's directions came in: a second one takes 18 s and 13 MB.
    assert len(levenberg_marquardt.minimize.signatures) == 1


def test_meshes_call_the_kernels_of_clouds():
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.1)
    fit_points(np.array(mesh.sample(500, seed=0)))
    known = set(point_cost.maximize.signatures)
    fit_mesh(mesh)
    decompose(mesh)
    assert set(point_cost.maximize.signatures) == known
