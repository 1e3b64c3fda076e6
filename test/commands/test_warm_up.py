"""``warm-up`` compiles all that frames call, so that no camera waits for a compiler."""

from __future__ import annotations

import sys

import numpy as np
from numba.core.dispatcher import Dispatcher

from sq_perception.commands import installation
from sq_perception.fitting import levenberg_marquardt
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation.scenes import TABLE_CAMERA, draw_crowd, table_scene


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
