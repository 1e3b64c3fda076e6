"""Make the parts of the documents that are measured or read from the source; never edit them by hand.

    python docs_build/blocks.py     rewrites them in README.md and docs/

A document holds such a part between two lines, ``<!-- made by docs_build/blocks.py: NAME -->`` and ``<!-- end -->``.
Figures come from benchmarks/results/*.json and from the header of the weights, the packages from ``LAYERS`` of
test/package/test_imports.py and from their docstrings.  A test compares.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "sq_perception"
_BLOCK = re.compile(r"(<!-- made by docs_build/blocks\.py: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def documents() -> list[Path]:
    """The pages that may hold blocks."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def renewed(text: str) -> str:
    """A page with its blocks as they should be; raises KeyError for a block of an unknown name."""
    return _BLOCK.sub(lambda match: f"{match[1]}{BLOCKS[match[2]]().rstrip()}\n{match[3]}", text)


def table(head: str, rows: Iterable[str]) -> str:
    """A table of Markdown; cells are divided by ``|``."""
    lines = [f"| {head} |", f"|{'---|' * (head.count('|') + 1)}", *(f"| {row} |" for row in rows)]
    return "\n".join(lines) + "\n"


# Figures

HULL, EDGES, SIGMAS = "IoU with the true convex hull %", "error of full edges mm", "within 2 sigma %"
BOTH_IOU = "IoU %, given / own masks"


def results(name: str) -> Any:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text(encoding="utf-8"))


def accuracy() -> str:
    """Images of the thesis' protocol: IoU from the evaluation, times of whole recoveries from the occlusion bench."""
    summaries = {one["name"]: one["summary"] for one in results("evaluation")["contestants"]}
    timed = results("occlusion")["rows"]["thesis, 0 % hidden"]
    supervised = "94.62 +- 3.18, 2.88 ms on a GPU"
    shown = [
        ("`auto`: network and fit", "auto", "auto", ""),
        ("`symmetry`: fit only", "symmetry", "symmetry", ""),
        ("`network`, `supervised`", "supervised", "network supervised", supervised),
        ("`network`, `robust` (default)", "robust", "network robust", ""),
        ("`classic`: Solina and Bajcsy", "classic", "classic", "84.51 +- 8.89, 690 ms"),
    ]
    rows = []
    for title, name, clock, thesis in shown:
        of = summaries[name]
        mean, std, least, over = (100 * of[part] for part in ("iou_mean", "iou_std", "iou_min", "over_85"))
        time = timed[clock]["milliseconds"]["median"]
        iou = f"{mean:.2f} +- {std:.2f} | {least:.1f} | {over:.1f}"
        rows.append(f"{title} | {of['bodies']} | {iou} | {time:.1f} | {thesis}")
    return table("method | bodies | IoU mean +- std | min | > 85 % | ms | thesis", rows)


def household() -> str:
    """Household things on a table through simulated sensors, at least half visible."""
    found = results("real_scenes")
    rows = []
    for name, text in (("given", "`auto`, given masks"), ("own", "`auto`, own masks"), ("classic", "`classic`, given")):
        row = found[f"all, at least half visible: {name}"]
        error, within = row["edge_error"], row["within_2_sigma"]
        sigma = "" if within is None else f"{within:.0f}"
        rows.append(f"{text} | {row['iou']['mean']:.1f} | {error['median']:.1f} / {error['mean']:.1f} | {sigma}")
    return table(f"method | {HULL} | {EDGES}, median / mean | {SIGMAS}", rows)


def kinds() -> str:
    """The same by the kind of thing and by how much of it is visible; in the end the harder things."""
    scenes, harder = results("real_scenes"), results("household_things")
    names = {
        **{name: name for name in ("box", "can", "bottle", "scan")},
        "50 to 90 % visible": "visible: 50 to 90 %",
        "under 50 % visible": "visible: under 50 %",
    }
    shown = [(title, scenes[f"{name}: given"], scenes[f"{name}: own"]) for title, name in names.items()]
    every = "all, at least half visible"
    shown.append(("harder objects", harder[f"{every}: given"], harder[f"{every}: own"]))
    rows = []
    for title, given, own in shown:
        iou = f"{given['iou']['mean']:.1f} / {own['iou']['mean']:.1f}"
        error = f"{given['edge_error']['median']:.1f} / {own['edge_error']['median']:.1f}"
        rows.append(f"{title} | {given['iou']['count']:.0f} | {iou} | {error} | {given['within_2_sigma']:.0f}")
    return table(f"objects | number | {BOTH_IOU} | error of edges mm, median | {SIGMAS}, given masks", rows)


def prediction() -> str:
    """Errors of the network of things, from the header of its weights."""
    path = PACKAGE / "weights" / "things.safetensors"
    with path.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    metadata = header["__metadata__"]
    validation = json.loads(metadata.get("metrics") or metadata["validation"])
    kinds = {name: values for name, values in validation.items() if isinstance(values, list)}
    least, most = (choose(kinds, key=lambda name: kinds[name][1]) for choose in (min, max))
    return (
        f"Mean error {100 * validation['error']:.1f} % of the view, {validation['ratio']:.2f} times sigma; by kind "
        f"{kinds[least][1]:.2f} ({least}) to {kinds[most][1]:.2f} ({most})."
    )


def frame_time() -> str:
    """Whole frames of a simulated RealSense, VGA, own masks."""
    found = results("frame_time")["rows"]
    rows = []
    for count in (1, 5, 20):
        row = found[f"realsense_d435, 640 x 480, {count}, own"]
        total = row["stages"]["total"]
        parts = ", ".join(f"{row['stages'][stage]['median']:.0f}" for stage in ("segmentation", "network", "fit"))
        grasps = row["surroundings"]["median"] + row["plan"]["median"]
        rows.append(f"{count} | {total['median']:.0f} / {total['p95']:.0f} | {parts} | {grasps:.0f}")
    return table("bodies | ms median / p95 | segmentation, network, fit | grasp planning, ms", rows)


def latency() -> str:
    """From an image's stamp to its result in another process."""
    names = {
        "thesis 256 x 256": "256 x 256 orthographic, one body, ideal sensor",
        "table 640 x 480, one object": "640 x 480, table-top, one body, ideal sensor",
        "table 640 x 480, five objects": "640 x 480, table-top, five bodies, simulated D435",
        "five objects, 3 times the rate": "the same at 90 Hz",
    }
    rows = []
    for name, text in names.items():
        case = results("node_latency")["cases"][name]
        times = " / ".join(f"{case['milliseconds'][part]:.1f}" for part in ("median", "p95", "max"))
        rows.append(f"{text} | {times} | {case['results_per_second']:.1f}")
    return table("frame | ms median / p95 / max | results / s", rows)


def cameras() -> str:
    """What a second camera tells of household things."""
    found = results("two_cameras")["rows"]
    rows = []
    for masks in ("given", "own"):
        one, two = found[f"{masks}, one"], found[f"{masks}, two"]
        edges = ", ".join(f"{1e3 * row['edge']:.1f} / {1e3 * row['median_edge']:.1f}" for row in (one, two))
        weak, covered = (f"{100 * one[key]:.0f}, {100 * two[key]:.0f}" for key in ("weak", "covered"))
        rows.append(f"{masks} | {edges} | {weak} | {100 * one['iou']:.1f}, {100 * two['iou']:.1f} | {covered}")
    return table(f"masks | edge error mm, mean / median | weak % | IoU % | {SIGMAS}", rows)


# The packages


def package_layers() -> tuple[tuple[str, ...], ...]:
    """``LAYERS`` of test/package/test_imports.py, from the lowest up."""
    tree = ast.parse((ROOT / "test" / "package" / "test_imports.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            value: tuple[tuple[str, ...], ...] = ast.literal_eval(node.value)
            return value
    raise LookupError("test/package/test_imports.py has no LAYERS")


def packages() -> str:
    """The subpackages, layers in brackets, with their purpose from their docstring; the highest layer first."""
    layers = package_layers()
    rows = (
        f"- [`{name}/`](../sq_perception/{name}/__init__.py) ({number}): {purpose(name)}"
        for number in range(len(layers), 0, -1)
        for name in layers[number - 1]
    )
    return "\n".join(rows)


def purpose(package: str) -> str:
    """The beginning of a package's docstring, up to a colon or the end of the sentence."""
    docstring = ast.get_docstring(ast.parse((PACKAGE / package / "__init__.py").read_text(encoding="utf-8"))) or ""
    return re.split(r"[:.]\s|[:.]$", " ".join(docstring.split()), maxsplit=1)[0]


def known() -> str:
    """Recorded frames of known sizes: what the fit makes of each kind."""
    groups = results("known_frames")["groups"]

    def both(kind: str, key: str, scale: float, digits: int = 1) -> str:
        pair = (groups[kind][f"auto, {masks}"][key] for masks in ("given", "own"))
        return " / ".join("-" if one is None else f"{scale * one:.{digits}f}" for one in pair)

    rows = []
    for kind in ("box", "cylinder", "bottle", "vessel", "other"):
        errors = f"{both(kind, 'iou', 100)} | {both(kind, 'error_median', 1e3)} | {both(kind, 'two_sigma', 100, 0)}"
        rows.append(f"{kind} | {groups[kind]['auto, given']['things']} | {errors}")
    return table(f"objects | number | {BOTH_IOU} | error of edges mm, median | {SIGMAS}", rows)


def public() -> str:
    """Things of known size in frames of public repositories: all, and kinds of four and more."""
    groups = results("public_frames")["groups"]
    rows = []
    for title, one in groups.items():
        if not title.startswith("sensor") and one["things"] >= 4:
            known = f"{one['edges median']:.1f} / {one['edges mean']:.1f}"
            shares = "-" if one["within 2"] is None else f"{one['within 2']:.0f} / {one['beyond 3']:.0f}"
            iou = "-" if one["iou"] is None else f"{one['iou']:.1f} ({one['posed']})"
            name = title.removeprefix("kind: ").replace("_", " ")
            rows.append(f"{name} | {one['things']} | {known} | {shares} | {iou} | {one['found']}")
    head = f"objects | number | {EDGES}, median / mean | CONVERGED: within 2 / beyond 3 sigma % | IoU % (posed)"
    return table(f"{head} | found, own masks", rows)


ABLATIONS = {
    "whole": "as shipped",
    "no predicted hull": "no predicted hull",
    "no plane": "no support plane",
    "no free space": "no free space",
    "missing is empty": "missing readings count as empty space",
    "half the error": "predicted hull with half the error",
    "true hull": "true hull instead of the predicted one",
}
"""Rows of the ablation that are shown."""


def ablation() -> str:
    """The fit without one source of knowledge at a time."""
    found = [results("ablation")[name] for name in ("household", "recorded")]
    rows = []
    for name, text in ABLATIONS.items():
        cells = " | ".join(f"{one[name]['iou']:.1f} ({one[name]['difference']:+.1f})" for one in found)
        rows.append(f"{text} | {cells}")
    household, recorded = (one["whole"]["count"] for one in found)
    return table(f"fit | household, {household} objects | recorded, {recorded} objects", rows)


def recorded() -> str:
    """The fair kinds of the recorded frames, by method."""
    rows = []
    for title, one in results("known_frames")["groups"]["fair"].items():
        if title == "EMS":  # the better of the two is shown
            continue
        method, comma, masks = title.partition(",")
        sigma = "" if one["two_sigma"] is None else f"{100 * one['two_sigma']:.0f}"
        errors = f"{1e3 * one['error_median']:.1f} / {1e3 * one['error_mean']:.1f}"
        rows.append(f"`{method}`{comma}{masks} | {100 * one['iou']:.1f} | {errors} | {sigma}")
    return table(f"method, masks | {HULL} | {EDGES}, median / mean | {SIGMAS}", rows)


PICKERS = {
    "ours": "recovered bodies, covariance",
    "ours without sigma": "sigma of 10 % of the size",
    "ours without the hull": "without the predicted hull",
    "true bodies": "true bodies",
    "classic": "`classic` fit",
    "box": "smallest box of the points",
    "centroid": "straight down, no planner",
    "cgn in masks": "Contact-GraspNet in our masks",
    "cgn": "Contact-GraspNet alone",
}
"""Contestants of the picking benchmark; those that tried both kinds of scenes are shown."""


def picking() -> str:
    """Share of grasps that hold and of objects that are removed, by contestant."""
    found = results("picking")["rows"]
    rows = []
    for who in (one for one in PICKERS if {f"packed: {one}", f"pile: {one}"} <= set(found)):
        kinds = [found[f"{kind}: {who}"] for kind in ("packed", "pile")]
        cells = " | ".join(f"{one['gsr'][0]:.0f} / {one['dr'][0]:.0f}" for one in kinds)
        rows.append(f"{PICKERS[who]} | {cells}")
    return table("planned on | packed: GSR / DR % | pile: GSR / DR %", rows)


BLOCKS: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        accuracy,
        household,
        kinds,
        prediction,
        known,
        public,
        ablation,
        recorded,
        frame_time,
        latency,
        picking,
        cameras,
        packages,
    )
}


def main() -> None:
    """Rewrite every block."""
    for page in documents():
        text = page.read_text(encoding="utf-8")
        if (new := renewed(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(page.relative_to(ROOT))


if __name__ == "__main__":
    main()
