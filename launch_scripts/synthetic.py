#!/usr/bin/env python3
"""A synthetic depth camera with recover_node and fitter_node behind it; needs no launch package.

python3 synthetic.py --scene table --rate 10
python3 synthetic.py --scene replay --path frame.npz
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sq_perception.nodes import fast_dds
from sq_perception.nodes.children import Children, parameter_arguments


def main() -> int:
    """Run until Ctrl-C, or until a node ends by itself; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="table", choices=("thesis", "table", "replay"))
    parser.add_argument("--path", type=Path, help="recorded frame or folder of frames, for --scene replay")
    parser.add_argument("--projection", choices=("pinhole", "orthographic"), help="of recorded frames")
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second")
    parser.add_argument("--seed", type=int, default=0, help="of scenes and noise")
    options = parser.parse_args()

    projection = options.projection or ("orthographic" if options.scene == "thesis" else "pinhole")
    camera = {"scene": options.scene, "rate": options.rate, "seed": options.seed, "projection": projection}
    if options.path is not None:
        camera["path"] = str(options.path.resolve())
    with Children(fast_dds.environment(), echo=True) as nodes:
        for name in ("recover_node", "fitter_node"):
            nodes.start(name, parameter_arguments({"projection": projection}))
        nodes.start("synthetic_depth_node", parameter_arguments(camera))
        return nodes.until_stopped()


if __name__ == "__main__":
    sys.exit(main())
