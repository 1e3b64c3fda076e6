"""The lines that ``sq-perception recover`` prints: one per body, each reason once, details on request.

    0 converged 480 x 196 x 214 mm (+-5 +-11 +-7) at 0.12 0.03 0.84 m

The number is the body's index in ``superquadrics``, as in meshes and pictures.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sq_perception.fitting.fit import CUT_SHORT
from sq_perception.recovery.recovery import edges_as_text, place_as_text

_AXES = re.compile(" along [xyz]( and [xyz])*")
"""Names of axes, which the deviations show anyway."""


def lines(entries: Sequence[Mapping[str, Any]], verbose: bool) -> Iterator[str]:
    """Return the lines of all frames, then the reasons with their number of bodies."""
    reasons: Counter[tuple[str, str]] = Counter()
    for entry in entries:
        stamp = entry["stamp"]
        taken = "" if stamp is None else f"  {stamp['sec']}.{stamp['nanosec']:09d}"
        yield f"{entry['file']}{taken}  {entry['ms']:.0f} ms  {entry['message']}".rstrip()
        if verbose:
            yield "  " + ", ".join(f"{stage} {value:.0f} ms" for stage, value in entry["ms_by_stage"].items())
        for number, body in enumerate(entry["superquadrics"]):
            yield "  " + _line(number, body, entry["coordinates"] == "cube")
            for part in body.get("parts", ()):
                edges = edges_as_text(part["size"], _sigmas(part), False)
                place = place_as_text(part["translation"], False)
                yield f"    part {part['share']:.0%} {part['status']} {edges} at {place}"
            if verbose:
                yield "    " + _details(body)
            elif body["status"] != "converged":
                reasons[body["status"], _AXES.sub("", body["message"].partition(";")[0])] += 1
    for (status, reason), count in reasons.most_common():
        yield f"{count} {status}: {reason}"
    if reasons:
        yield "what to do with them: docs/how_sure.md; -v shows more of each body"


def scene_lines(scene: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Return the lines of the bodies of all frames together, in the world of their camera poses."""
    for body in scene:
        edges, place = edges_as_text(body["size"], body["sigma_size"], False), place_as_text(body["translation"], False)
        yield f"  {body['status']} {edges} at {place} id {body['id']}, in {body['seen']} frames"


def _line(number: int, body: Mapping[str, Any], is_cube: bool) -> str:
    parts = [str(number), body["status"]]
    if CUT_SHORT in body["message"]:
        parts.append(f"({CUT_SHORT})")
    if body["status"] != "failed":
        parts.append(edges_as_text(body["size"], _sigmas(body), is_cube))
    parts.append(f"at {place_as_text(body['translation'], is_cube)}")
    if body["label"] is not None:
        parts.append(f" mask {body['label']}")
    if body["track"] is not None:
        parts.append(f" id {body['track']['id']}")
    return " ".join(parts)


def _sigmas(body: Mapping[str, Any]) -> list[float]:
    return [math.nan if value is None else value for value in body["sigma_size"]]


def _details(body: Mapping[str, Any]) -> str:
    known = {
        "exponents": " ".join(f"{value:.2f}" for value in body["shape"]),
        "score": f"{body['score']:.3f}",
        "seen": " ".join("?" if share is None else f"{share:.0%}" for share in body["seen"]),
        "pixels": str(body["pixels"]),
    }
    return ", ".join(f"{name} {value}" for name, value in known.items()) + f": {body['message']}"
