"""``sq-perception sample``: a simulated frame and its true bodies."""

from __future__ import annotations

from collections.abc import Sequence

from sq_perception.commands.console import SUCCESS, parser, reject_usage, target
from sq_perception.files import output_file

_HELP = """\
Write a simulated RealSense D435 depth image of four objects on a table, and print their true sizes.
The NPZ holds what `sq-perception recover` reads of one: depth (metres, NaN = no reading) and K (3 x 3).
"""
_EPILOG = """\
examples:
  sq-perception sample table.npz
  sq-perception recover table.npz --html page.html
"""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception sample``; return the exit code."""
    command = parser("sample", _HELP, _EPILOG)
    command.add_argument("output", type=target, metavar="FILE", help="an .npz")
    output = command.parse_args(arguments).output
    if output.suffix.lower() != ".npz":
        return reject_usage(f"{output}: expected a name that ends in .npz")

    import numpy as np

    from sq_perception.recovery.recovery import edges_as_text, place_as_text
    from sq_perception.simulation.sample import sample

    made = sample()
    with output_file.writing(output) as partial, partial.open("wb") as file:
        np.savez_compressed(file, depth=made.depth, K=made.camera.matrix)
    unknown = [np.nan] * 3
    print(f"{output}: {made.camera.width} x {made.camera.height}, a simulated RealSense D435; true full edges")
    for name, body in zip(made.names, made.bodies, strict=True):
        edges = edges_as_text(body.size, unknown, is_cube=False)
        print(f"  {name:8}{edges:22} at {place_as_text(body.translation, is_cube=False)}")
    return SUCCESS
