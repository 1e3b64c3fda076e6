"""Networks trained by each loss, alone, on bodies of the thesis' protocol that no training used.

    python benchmarks/losses.py [runs/render runs/least_squares ...]

Every folder is the output of one ``sq-perception train`` with its model.safetensors, whose header says what was
trained; without any, those in runs/ are taken.  Images, seeds and what is counted are those of ``sq-perception
evaluate``: IoU of whole bodies and on the thesis' grid (equation 5.1), Delta A, E and T (5.2 to 5.4), T in per cent of
the cube, and quarter turns (figure 6.3).  Where size, shape and place are given, they are taken from the label, whose
axes are listed as they were in the training.
"""

from __future__ import annotations

from pathlib import Path

if __name__ == "__main__":
    import one_thread  # noqa: F401


import report

from sq_perception.evaluation.contest import compare, network
from sq_perception.evaluation.thesis_images import ThesisImages

THESIS = {
    "occupancy": "94.62 +- 3.18",
    "dual": "62.76 +- 11.34",
    "occupancy_rotation": "75.02",
    "least_squares": "74.82 +- 14.50",
    "render": "85.64 +- 5.72",
}


def main() -> None:
    found = sorted(path.parent for path in Path("runs").glob("*/model.safetensors"))
    parser = report.parser(__doc__)
    parser.add_argument("runs", type=Path, nargs="*", default=found)
    parser.add_argument("--bodies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=2020)
    options = parser.parse_args()
    if not options.runs:
        print("runs/ holds no trained network; see sq-perception train --help")
        return
    networks = [network(folder / "model.safetensors", folder.name) for folder in options.runs]
    result, rows = {}, []
    outcomes = compare([(one, options.bodies) for one in networks], ThesisImages(options.bodies, options.seed))
    for outcome in outcomes:
        one, metrics = outcome.contestant, outcome.contestant.notes["metrics"]
        iou, summary = outcome.figures.volume_iou, outcome.figures.summary()
        steps, minutes = metrics["step"], metrics["seconds"] / 60
        trained = {"loss": one.loss, "steps": steps, "minutes": minutes, "training": one.notes["training"]}
        result[one.name] = {**trained, "iou": report.spread(iou), "summary": summary}
        rows.append(
            {
                "run": one.name,
                "steps / min": f"{steps} / {minutes:.0f}",
                "IoU %": f"{100 * iou.mean():.2f} +- {100 * iou.std():.2f}",
                "over 85 %": f"{100 * (iou > 0.85).mean():.1f}",
                "thesis IoU %": f"{100 * summary['iou_mean']:.2f} +- {100 * summary['iou_std']:.2f}",
                "dA %": f"{100 * summary['delta_a']:+.1f}",
                "dE %": f"{100 * summary['delta_e']:+.1f}",
                "dT %": ", ".join(f"{100 * value:+.2f}" for value in summary["delta_t"]),
                "quarter turns %": f"{100 * summary['quarter_turns']:.0f}",
                "thesis: IoU %": THESIS.get(one.loss, ""),
            }
        )
    report.write("losses", {"bodies": options.bodies, "runs": result}, report.table_of(rows))


if __name__ == "__main__":
    main()
