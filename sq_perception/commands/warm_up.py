"""``sq-perception warm-up``: compile every kernel and keep it on disk, so that the first image does not wait.

Compiled code is kept beside the modules, or in the user's cache if that folder cannot be written.  ``--only`` names
the steps that another process runs at the same time: what a first recovery needs beside the fit.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from sq_perception.commands.console import SUCCESS, parser

_HELP = "Compile every kernel once and keep it on disk (a minute or two), so that the first image does not wait."


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception warm-up``: run every step and print how long each took."""
    command = parser("warm-up", _HELP)
    command.add_argument("--only", nargs="+", metavar="STEP", help="of its steps only these")
    only = command.parse_args(arguments).only
    if only is None:
        from sq_perception.geometry import kernel_cache

        kernel_cache.compile_beside()
    logging.getLogger("sq_perception.geometry.kernel_cache").setLevel(logging.ERROR)  # it says itself how far it is
    for name, action in steps():
        if only is not None and name not in only:
            continue
        began = time.perf_counter()
        print(f"preparing {name} ...", end=" ", flush=True)
        action()
        print(f"{time.perf_counter() - began:.1f} s", flush=True)
    return SUCCESS


def steps() -> list[tuple[str, Callable[[], object]]]:
    """Return name and action of each step that compiles."""
    import numpy as np

    from sq_perception.fitting import solina_bajcsy, surface_fit
    from sq_perception.geometry import metrics
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.grasping import planner
    from sq_perception.imaging import raycast
    from sq_perception.imaging.camera import Camera
    from sq_perception.recovery import still_scene
    from sq_perception.recovery.recoverer import Recoverer
    from sq_perception.segmentation import segments
    from sq_perception.simulation import scenes, view_rendering
    from sq_perception.tracking import association

    batch = Superquadric.from_flat(np.array([[0.1, 0.2, 0.3, 0.5, 0.8, 0, 0, 1, 0, 0, 0, 1]]))
    body = batch[0]
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
    points = body.sample_surface(50, np.random.default_rng(0))
    table = scenes.table_scene(np.random.default_rng(0), 2, Camera(160, 120, 150.0, 150.0, 79.5, 59.5))

    def recover() -> None:
        recoverer = Recoverer()
        recoverer.warm_up(table.camera)
        recoverer.recover(table.render()[0], table.camera)  # what stands on a plane takes kernels of its own

    return [
        ("ray casting", lambda: raycast.render(body, camera)),
        ("canonical views", lambda: view_rendering.render_views(batch, 16)),
        ("overlap", lambda: metrics.volume_iou(batch, batch, 16)),
        ("classic fit", lambda: solina_bajcsy.fit(points)),
        ("surface fit", surface_fit.warm_up),
        ("segmentation", segments.warm_up),
        ("network", lambda: Recoverer(method="network").recover(table.render()[0], table.camera)),
        ("still scenes", still_scene.warm_up),
        ("tracking", association.warm_up),
        ("grasps", planner.warm_up),
        ("a whole recovery", recover),
    ]
