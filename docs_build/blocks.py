"""The parts of the documents that can be measured or read from the source; nobody writes them by hand.

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
BOTH_IOU = "IoU %, masks given / own"


def results(name: str) -> Any:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text(encoding="utf-8"))


def accuracy() -> str:
    """Images of the thesis' protocol: IoU from the evaluation, times of whole recoveries from the occlusion bench."""
    summaries = {one["name"]: one["summary"] for one in results("evaluation")["contestants"]}
    timed = results("occlusion")["rows"]["thesis, 0 % hidden"]
    supervised = "94.62 +- 3.18, 99.06 over 85, 2.88 ms on a GPU"
    shown = [
        ("`auto`: network + surface fit", "auto", "auto", ""),
        ("`symmetry`: surface fit without the network", "symmetry", "symmetry", ""),
        ("`network` alone, weights `supervised`", "supervised", "network supervised", supervised),
        ("`network` alone, weights `robust` (default)", "robust", "network robust", ""),
        ("`classic`: Solina and Bajcsy", "classic", "classic", "84.51 +- 8.89, 690 ms"),
    ]
    rows = []
    for title, name, clock, thesis in shown:
        of = summaries[name]
        mean, std, least, over = (100 * of[part] for part in ("iou_mean", "iou_std", "iou_min", "over_85"))
        time = timed[clock]["milliseconds"]["median"]
        iou = f"{mean:.2f} +- {std:.2f} | {least:.1f} | {over:.1f}"
        rows.append(f"{title} | {of['bodies']} | {iou} | {time:.1f} | {thesis}")
    return table("method | bodies | IoU mean +- std | min | > 85 % | ms | the thesis reports", rows)


def household() -> str:
    """Household things on a table through simulated sensors, at least half visible."""
    found = results("real_scenes")
    names = {
        "given": "`auto`, masks given",
        "own": "`auto`, own masks",
        "classic": "`classic`, masks given",
        "oriented box": "smallest box of the seen points, masks given",
    }
    rows = []
    for name, text in names.items():
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
    shown.append(("harder things", harder[f"{every}: given"], harder[f"{every}: own"]))
    rows = []
    for title, given, own in shown:
        iou = f"{given['iou']['mean']:.1f} / {own['iou']['mean']:.1f}"
        error = f"{given['edge_error']['median']:.1f} / {own['edge_error']['median']:.1f}"
        rows.append(f"{title} | {given['iou']['count']:.0f} | {iou} | {error} | {given['within_2_sigma']:.0f}")
    return table(f"things | number | {BOTH_IOU} | error of edges mm, median | {SIGMAS}, masks given", rows)


def prediction() -> str:
    """Errors of the network of things, from the header of its weights."""
    path = PACKAGE / "weights" / "things.safetensors"
    with path.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    validation = json.loads(header["__metadata__"]["validation"])
    kinds = {name: values for name, values in validation.items() if isinstance(values, list)}
    least, most = (choose(kinds, key=lambda name: kinds[name][1]) for choose in (min, max))
    return (
        f"Mean error {100 * validation['error']:.1f} % of the view, {validation['ratio']:.2f} times sigma; by kind "
        f"{kinds[least][1]:.2f} ({least}) to {kinds[most][1]:.2f} ({most})."
    )


def camera_spread() -> str:
    """Figures of recorded images beside those of simulated cameras."""
    sources = {"mosd": "Kinect v1, 45 frames", "felix": "RealSense, 4", "pcl": "Kinect and stereo, 4"}
    rows = []
    for name, found in results("camera_spread").items():
        if isinstance(found, dict) and "within" in found:
            spread = " / ".join(f"{value:.2f}" for value in found["simulated"])
            medians = " | ".join(f"{found[source]:.2f}" for source in sources)
            rows.append(f"{name} | {spread} | {medians} | {100 * found['within']:.0f}")
    return table(f"figure | simulated, 5 / 50 / 95 % | {' | '.join(sources.values())} | frames within, %", rows)


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
    return table("bodies | ms median / p95 | of which segmentation, network, fit | grasps after it, ms", rows)


def latency() -> str:
    """From an image's stamp to its result in another process."""
    names = {
        "thesis 256 x 256": "256 x 256 orthographic, one body, ideal sensor",
        "table 640 x 480, one object": "640 x 480, table-top, one body, ideal sensor",
        "table 640 x 480, five objects": "640 x 480, table-top, five bodies, simulated D435",
        "five objects, 3 times the rate": "the same, 90 Hz offered",
    }
    rows = []
    for name, text in names.items():
        case = results("node_latency")["cases"][name]
        times = " / ".join(f"{case['milliseconds'][part]:.1f}" for part in ("median", "p95", "max"))
        rows.append(f"{text} | {times} | {case['results_per_second']:.1f} | {case['trend_ms']:+.1f} ms")
    return table("frame | ms median / p95 / max | results / s | trend", rows)


def still() -> str:
    """What a frame of things that stand still costs after another one."""
    rows = []
    for count, row in results("still_scenes")["rows"].items():
        after = f"{row['following']['median']:.1f} / {row['following']['mean']:.1f}"
        iou = " | ".join(f"{100 * row['iou'][name]['mean']:.1f}" for name in ("alone", "following"))
        rows.append(f"{count} | {row['alone']['median']:.0f} | {after} | {100 * row['repeated']:.0f} | {iou}")
    heads = "things | processor ms alone | after another, median / mean | taken from it % | IoU % alone | after another"
    return table(heads, rows)


def tracks() -> str:
    """Errors of sizes of tracked bodies by frame, per cent."""
    frames = ("1", "10", "30", "300")
    rows = []
    for name, row in results("tracking")["rows"].items():
        errors = " | ".join(f"{100 * row['error'][frame]:.2f}" for frame in frames)
        rows.append(f"{name} | {errors} | {100 * row['bias']:.2f} | {100 * row['within_2_sigma']:.0f}")
    after = " | ".join(f"after {frame}" for frame in frames)
    return table(f"camera, masks | {after} | common to all views | {SIGMAS}", rows)


# The packages


def package_layers() -> tuple[tuple[str, ...], ...]:
    """``LAYERS`` of test/package/test_imports.py, from the lowest up."""
    tree = ast.parse((ROOT / "test" / "package" / "test_imports.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            value: tuple[tuple[str, ...], ...] = ast.literal_eval(node.value)
            return value
    raise LookupError("test/package/test_imports.py has no LAYERS")


def layers() -> str:
    """A drawing of the layers, the highest first; modules import from their own layer and from those below."""
    rows = ["   ".join(layer) for layer in reversed(package_layers())]
    inner = max(map(len, rows))
    line = f"+{'-' * (inner + 2)}+"
    return "\n".join(["```text", line, *(f"| {row.center(inner)} |\n{line}" for row in rows), "```"])


def packages() -> str:
    """What each subpackage holds, by its docstring."""
    names = [name for layer in reversed(package_layers()) for name in layer]
    rows = (f"[`{name}/`](../sq_perception/{name}/__init__.py) | {purpose(name)}" for name in names)
    return table("package | holds", rows)


def purpose(package: str) -> str:
    """The beginning of a package's docstring, up to a colon or the end of the sentence."""
    docstring = ast.get_docstring(ast.parse((PACKAGE / package / "__init__.py").read_text(encoding="utf-8"))) or ""
    return re.split(r"[:.]\s|[:.]$", " ".join(docstring.split()), maxsplit=1)[0]


def speed() -> str:
    """What a frame costs, and where."""
    found = {
        name: row for name, row in results("speed")["rows"].items() if name == "thesis, auto" or name.endswith("own")
    }
    rows = []
    for name, row in found.items():
        shares = " | ".join(
            " / ".join(f"{100 * one:.0f}" for one in row[part].values()) for part in ("stages", "kinds")
        )
        rows.append(f"{name.removesuffix(', own')} | {row['loops']:.1f} | {row['classic']:.1f} | {shares}")
    shares = " | ".join(f"{' / '.join(next(iter(found.values()))[part])} %" for part in ("stages", "kinds"))
    return table(f"frame | times a loop | times classic fits | {shares}", rows)


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
    return table(f"things | number | {BOTH_IOU} | error of edges mm, median | {SIGMAS}", rows)


ABLATIONS = {
    "whole": "as shipped",
    "no predicted hull": "no predicted hull",
    "as a body": "as a body, not as a hull",
    "no plane": "no support plane",
    "no free space": "no free space",
    "missing is empty": "missing readings are empty space",
    "half the error": "a predicted hull that errs by half",
    "true behind": "the true hull on the far side alone",
    "true hull": "the true hull in place of the predicted",
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
    return table(f"fit | household, {household} things | recorded, {recorded} things", rows)


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
    "ours without sigma": "with 10 % of the size as sigma",
    "ours without the hull": "without the predicted hull",
    "true bodies": "true bodies",
    "classic": "`classic` fit",
    "box": "smallest box of the points",
    "centroid": "straight down, no planner",
    "cgn in masks": "Contact-GraspNet in our masks",
    "cgn": "Contact-GraspNet alone",
}
"""Contestants of the picking benchmark; those that tried both kinds of scenes are shown."""
FAILURES = ("collision", "wrong size", "missed", "slipped")
GAINS = {
    "ours without sigma": "covariance over 10 % of the size",
    "ours without the hull": "predicted hull over release 0.2.0's predicted body",
    "classic": "our fit over the classic one",
    "cgn in masks": "over Contact-GraspNet in our masks",
}
"""Whom the picking benchmark compares ours with."""


def picking() -> str:
    """Grasps in physics: how often one holds, how much is cleared, and why others failed."""
    found = results("picking")["rows"]
    rows = []
    for who in (one for one in PICKERS if {f"packed: {one}", f"pile: {one}"} <= set(found)):
        kinds = [found[f"{kind}: {who}"] for kind in ("packed", "pile")]
        cells = [f"{one['scenes']}: {_rate(one['gsr'])} / {_rate(one['dr'])}" for one in kinds]
        tried = sum(one["tried"] for one in kinds)
        *failed, unreachable = (sum(one["causes"][cause] for one in kinds) for cause in (*FAILURES, "unreachable"))
        causes = f"{tried}: {' / '.join(map(str, failed))}"
        rows.append(f"{PICKERS[who]} | {' | '.join(cells)} | {causes} | {unreachable}")
    heads = f"planned on | packed, scenes: GSR / DR % | pile | tried: {' / '.join(FAILURES)} | unreachable"
    return table(heads, rows)


def picking_gains() -> str:
    """What parts of the recovery are worth to grasps, and by how much others are behind."""
    gains = results("picking")["gains"]
    rows = []
    for other, name in GAINS.items():
        kinds = [gains[f"{kind}: ours over {other}"] for kind in ("packed", "pile")]
        values = ["{:+.0f} ({:+.0f} to {:+.0f})".format(*kind[rate]) for kind in kinds for rate in ("gsr", "dr")]
        scenes = " / ".join(dict.fromkeys(f"{kind['scenes'][0]:.0f}" for kind in kinds))
        rows.append(" | ".join([f"{name}, {scenes}", *values]))
    heads = "on the same scenes, points (95 % interval) | packed, GSR | packed, DR | pile, GSR | pile, DR"
    return table(heads, rows)


def picking_scores() -> str:
    """Scores of ours against what held."""
    runs = results("picking_scores")["rows"].values()
    means = []
    for k in range(5):
        bins = [one["bins"][k] for one in runs if one["bins"][k][0]]
        count = sum(one[0] for one in bins)
        means.append([f"{100 * sum(one[0] * one[of] for one in bins) / count:.0f}" for of in (1, 2)] + [str(count)])
    heads = ["score", *(f"{0.2 * k:.1f} to {0.2 * k + 0.2:.1f}" for k in range(5))]
    names = ("mean score %", "held %", "tried")
    rows = (" | ".join([name, *values]) for name, values in zip(names, zip(*means, strict=True), strict=True))
    return table(" | ".join(heads), rows)


def _rate(one: list[float]) -> str:
    """A rate in per cent with its interval."""
    return "{:.0f} ({:.0f}-{:.0f})".format(*one)


BLOCKS: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        accuracy,
        household,
        kinds,
        prediction,
        camera_spread,
        known,
        ablation,
        recorded,
        frame_time,
        speed,
        latency,
        still,
        picking,
        picking_gains,
        picking_scores,
        tracks,
        layers,
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
