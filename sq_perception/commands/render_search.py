"""``sq-perception render-search``: the grid search over s and tau of the thesis' figure 7.6."""

from __future__ import annotations

from collections.abc import Sequence

from sq_perception.commands.console import SUCCESS, at_least, misused, parser, target

_HELP = "The best s and tau of the soft renderer: the grid search of the thesis' figure 7.6."
_PICTURES = (".png", ".pdf", ".svg")
_EPILOG = "example:\n  sq-perception render-search --picture render_search.png"


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception render-search``; the exit code."""
    command = parser("render-search", _HELP, _EPILOG)
    add = command.add_argument
    add("--bodies", type=at_least(2), default=20, help="random bodies (default %(default)s)")
    add("--resolution", type=at_least(2), default=64, help="pixels and voxels a side (%(default)s)")
    add("--steps", type=at_least(2), default=21, help="values of s and of tau (default %(default)s)")
    add("--seed", type=at_least(0), default=2020, help="default %(default)s")
    add("--picture", type=target, metavar="FILE", help="draw the heat map there")
    options = command.parse_args(arguments)
    if options.picture and options.picture.suffix.lower() not in _PICTURES:
        return misused(f"--picture: {options.picture}: expected a name that ends in {', '.join(_PICTURES)}")

    import numpy as np

    from sq_perception.evaluation import plots, render_search
    from sq_perception.imaging.soft_agreement import THESIS_SHARPNESS, THESIS_TAU
    from sq_perception.simulation.scenes import thesis_bodies

    bodies = thesis_bodies(options.bodies, np.random.default_rng(options.seed))
    sharpness, taus = (np.geomspace(*limits, options.steps) for limits in (render_search.SHARPNESS, render_search.TAU))
    found = render_search.search(bodies, sharpness, taus, options.resolution)
    thesis = render_search.search(bodies, np.array([THESIS_SHARPNESS]), np.array([THESIS_TAU]), options.resolution)
    s, tau, error = found.best
    print(f"least MAE {error:.4f} at s = {s:.1f}, tau = {tau:.2f}")
    print(f"at the thesis' s = 117.3, tau = 4.82: {thesis.best[2]:.4f} (the thesis reports 0.0056)")
    if options.picture:
        plots.save(render_search.figure(found), options.picture)
    return SUCCESS
