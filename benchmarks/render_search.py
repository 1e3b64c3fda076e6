"""The best s and tau of the soft renderer: the grid search of the thesis' figure 7.6.

Images of random bodies of the thesis' protocol are drawn twice, by ray casting with the floor of 255 z as grey value,
and by the soft renderer (equations 7.8 to 7.10) on a grid of r^3 voxels.  The search reports for every pair

    MAE(s, tau) = mean_bodies mean_pixels | X - T(s, tau) |

and its least value.  The thesis found 0.0056 at s = 117.3, tau = 4.82 on its own range.  With images as exact as these
the error falls with s as far as one looks, down to the half step of a voxel: only the gradient, which a sharp
boundary has in a thin layer only, is a reason for a softer one.

python benchmarks/render_search.py --picture docs/render_search.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import report
import torch
from matplotlib.figure import Figure

from sq_perception.evaluation import plots
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, soft_render, unit_cube
from sq_perception.imaging.soft_agreement import THESIS_SHARPNESS, THESIS_TAU
from sq_perception.simulation.scenes import thesis_bodies

SHARPNESS = (10.0, 1000.0)
TAU = (0.25, 32.0)


@dataclass(frozen=True, eq=False)
class RenderSearch:
    """Mean absolute errors of a grid.

    Attributes
    ----------
    sharpness, tau : (m,), (n,)
        Values tried, ascending.
    error : (m, n)
        MAE in sides of the cube.
    """

    sharpness: np.ndarray
    tau: np.ndarray
    error: np.ndarray

    @property
    def best(self) -> tuple[float, float, float]:
        """s, tau and MAE where the error is least."""
        row, column = np.unravel_index(np.argmin(self.error), self.error.shape)
        return float(self.sharpness[row]), float(self.tau[column]), float(self.error[row, column])


def search(bodies: Superquadric, sharpness: np.ndarray, tau: np.ndarray, resolution: int = 64) -> RenderSearch:
    """Try every pair on NumPy bodies (n,) of the cube frame, in images of ``resolution`` pixels and as many voxels."""
    axis = soft_render.grid_points(resolution).float()
    camera = unit_cube.camera(resolution)
    error = np.zeros((len(sharpness), len(tau)))
    with torch.no_grad():
        for body in bodies:
            depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
            exact = torch.from_numpy(unit_cube.grey_from_depth(depth).astype(np.float32) / 255)
            single = Superquadric.from_flat(torch.tensor(body.to_flat(), dtype=torch.float32)[None])
            for row, s in enumerate(sharpness):
                occupancy = soft_render.occupancy_grid(single, axis, float(s))[0]
                soft = (soft_render.depth_projection(occupancy, float(t)) for t in tau)
                error[row] += [float((image - exact).abs().mean()) for image in soft]
    return RenderSearch(np.asarray(sharpness, dtype=float), np.asarray(tau, dtype=float), error / len(bodies))


def figure(found: RenderSearch) -> Figure:
    """The errors as a heat map on logarithmic scales, the optimum and the thesis' one marked."""
    sheet = plots.new_figure(6.4, 4.8)
    sheet.set_layout_engine("constrained")
    ax = sheet.add_subplot()
    mesh = ax.pcolormesh(found.tau, found.sharpness, np.log10(found.error), shading="nearest", cmap="viridis")
    bar = sheet.colorbar(mesh, ax=ax)
    ticks = np.array([0.003, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2])
    ticks = ticks[(ticks >= found.error.min()) & (ticks <= found.error.max())]
    bar.set_ticks(np.log10(ticks), labels=[f"{tick:g}" for tick in ticks])
    bar.set_label("MAE, sides of the cube")
    s, tau, error = found.best
    ax.plot(tau, s, "o", color="white", label=f"least {error:.4f}: s = {s:.1f}, tau = {tau:.2f}")
    ax.plot(THESIS_TAU, THESIS_SHARPNESS, "x", color="white", label="thesis: 117.3, 4.82")
    ax.set(xscale="log", yscale="log", xlabel="tau", ylabel="s", title="Soft against exact images")
    ax.legend(loc="lower right", facecolor=plots.INK, labelcolor="white", fontsize=8)
    return sheet


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--bodies", type=int, default=20, help="random bodies (default %(default)s)")
    parser.add_argument("--resolution", type=int, default=64, help="pixels and voxels a side (%(default)s)")
    parser.add_argument("--steps", type=int, default=21, help="values of s and of tau (default %(default)s)")
    parser.add_argument("--seed", type=int, default=2020, help="default %(default)s")
    parser.add_argument("--picture", type=Path, help="PNG to draw the heat map to")
    options = parser.parse_args()
    bodies = thesis_bodies(options.bodies, np.random.default_rng(options.seed))
    sharpness, taus = (np.geomspace(*limits, options.steps) for limits in (SHARPNESS, TAU))
    found = search(bodies, sharpness, taus, options.resolution)
    thesis = search(bodies, np.array([THESIS_SHARPNESS]), np.array([THESIS_TAU]), options.resolution)
    s, tau, error = found.best
    print(f"least MAE {error:.4f} at s = {s:.1f}, tau = {tau:.2f}")
    print(f"at the thesis' s = 117.3, tau = 4.82: {thesis.best[2]:.4f} (the thesis reports 0.0056)")
    if options.picture:
        plots.save(figure(found), options.picture)


if __name__ == "__main__":
    main()
