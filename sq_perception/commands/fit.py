"""``sq-perception fit``: clouds and meshes of single objects in, one superquadric or several out; no camera."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sq_perception.commands import console

HELP = """\
Fit superquadrics to point clouds or meshes of single objects, seen from all sides or some.

A FILE is a cloud (.pcd, .ply, .npy of shape (n, 3)) or a mesh (.ply, .obj, .stl, .off), in any unit and frame; bodies
have the same.  For a depth image, or a cloud from one camera, use 'sq-perception recover'.
"""
EPILOG = """\
one line per body:
  0 converged 480.0 x 196.0 x 214.0 (+-5.1 +-11.0 +-7.2) at 0.120 0.030 0.840, 62 % of the points
  Status, FULL edges with standard deviations in thousandths of the file's unit (mm if that is metres), centre, and
  share of the points that the body explains.

examples:
  sq-perception fit mug.ply
  sq-perception fit drill.obj --most 6 --json drill.json
"""


def main(arguments: Sequence[str]) -> int:
    """Run ``sq-perception fit``; return the exit code."""
    command = console.parser("fit", HELP, EPILOG)
    add = command.add_argument
    add("files", nargs="+", metavar="FILE", help="clouds or meshes of one object each")
    add("--most", type=console.at_least(1, 20), default=1, metavar="N", help="fit up to N bodies (default 1)")
    add("--sigma", type=console.positive, metavar="S", help="noise of the points in their unit (default: estimated)")
    add("--no-taper", action="store_true", help="fit no taper (one body only)")
    add("--json", type=console.text_target, metavar="OUT", help="write the results there; - is the standard output")
    options = command.parse_args(arguments)
    if options.no_taper and options.most > 1:
        return console.complain("--no-taper: only with one body", console.USAGE)
    return _run(options)


def _run(options: argparse.Namespace) -> int:
    from sq_perception.files.unpacking import UnpackingError
    from sq_perception.recordings.cloud_file import read_surface

    if options.json and Path(options.json).resolve() in {Path(name).resolve() for name in options.files}:
        return console.complain(f"--json: {options.json} is read as well", console.USAGE)
    code, entries = console.SUCCESS, []
    for name in options.files:
        try:
            entry = _fit(name, read_surface(Path(name)), options)
        except (UnpackingError, OSError, ValueError) as error:
            code = console.complain(f"{name}: {error}")
            continue
        entries.append(entry)
        if options.json != console.STANDARD_OUTPUT:
            print(f"{name}  {entry['ms']:.0f} ms  {entry['status']}: {entry['message']}")
            for number, body in enumerate(entry["superquadrics"]):
                print(f"  {number} {_line(body)}")
    if options.json:
        document = {"format": "sq_perception.points", "version": 1, "files": entries}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        if (entries or options.json == console.STANDARD_OUTPUT) and (
            problem := console.write_document("json", options.json, text, code == console.SUCCESS)
        ):
            console.complain(problem)
    return code


def _fit(name: str, surface: Any, options: argparse.Namespace) -> dict[str, Any]:
    from sq_perception.fitting.decomposition import decompose
    from sq_perception.fitting.fit import Fit, Parts
    from sq_perception.fitting.points import fit_points, surface_of
    from sq_perception.recordings.result_json import plain_values

    points, normals = surface_of(surface)
    whole: Parts | Fit
    if options.most > 1:
        whole = parts = decompose(points, normals, most=options.most, sigma=options.sigma)
        fits, shares = list(parts), [float(share) for share in parts.shares]
    else:
        whole = fit = fit_points(points, normals, taper=not options.no_taper, sigma=options.sigma)
        fits, shares = [fit], [fit.inlier_share]
    entry = {
        "file": name, "points": len(points), "status": whole.status.name.lower(), "message": whole.message,
        "noise": whole.noise, "ms": round(whole.milliseconds, 3),
        "superquadrics": [_entry(fit, share) for fit, share in zip(fits, shares, strict=True)],
    }
    return plain_values(entry)


def _entry(fit: Any, share: float) -> dict[str, Any]:
    body = fit.superquadric
    return {
        "status": fit.status.name.lower(), "message": fit.message, "size": body.size, "shape": body.shape,
        "taper": body.taper, "translation": body.translation, "rotation": body.rotation,
        "sigma_size": fit.sigma_size, "covariance": fit.covariance, "share": share,
    }


def _line(body: dict[str, Any]) -> str:
    edges = " x ".join(f"{2e3 * value:.1f}" for value in body["size"])
    doubts = " ".join("+-?" if value is None else f"+-{2e3 * value:.1f}" for value in body["sigma_size"])
    at = " ".join(f"{value:.3f}" for value in body["translation"])
    share = "" if body["share"] is None else f", {body['share']:.0%} of the points"
    return f"{body['status']} {edges} ({doubts}) at {at}{share}"
