"""Thousands of hostile messages against a running node: does it live, does it log why, is the next good frame right?

    python benchmarks/hostile.py [--messages 20000] [--seed 0] [--node recover_node]

The frames are those of ``test/helpers/hostile_messages.py``: images, camera_infos and masks with wrong encodings,
sizes, steps, lengths, byte orders, stamps, frames, pixels, matrices, distortions, regions.  Half of them come without
masks, half with.  Each is sent over DDS to the node's own process and checked by it: ``~/trigger`` answers with what
became of it.  After every hundred a good frame follows, whose bodies are compared with those of the beginning.
"""

from __future__ import annotations

import re
import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from common import (
    own_domain,  # noqa: F401
    report,
)
from common.process_usage import usage
from hostile_messages import HostileFrame, Siege, Verdict, difference, frames
from hypothesis import HealthCheck, Phase, given, seed, settings
from running_nodes import Peer, arguments, environment, until
from sensor_msgs.msg import Image
from started_nodes import Children

from sq_msgs_py.superquadrics import from_message

EVERY = 100
_UNDISTURBED = 30
_SAME = 5e-3
"""Metres: fused over the good frames, the bodies of a noiseless image stay within this of the first ones."""
_NUMBERS = re.compile(r"-?\b\d[\d.e+-]*\b|\bnan\b|-?\binf\b|'[^']*'|\"[^\"]*\"", re.DOTALL)


class Benchmark:
    """Counts what a node answers, and asks it now and then whether it still sees."""

    def __init__(self, node: str, peer: Peer, children: Children) -> None:
        self.name, self.peer = f"/{node}", peer
        self.child = children.start(node, arguments("no_frame_warning:=0.0", "patience:=0.02"))
        self.siege = Siege(peer, self.name, (self.child,))
        self.answers, self.reports = peer.answers(self.name), peer.diagnoses(self.name)
        self.first = from_message(self._good()[0].message)
        self.verdicts: list[Verdict] = []
        self.undisturbed: dict[str, list[float]] = {}
        self.good: dict[str, list[tuple[float, float]]] = {}
        self.phase = ""
        self.memory = [usage(self.child.pid).rss]

    def _good(self) -> tuple[Any, float]:
        image, info = self.peer.frame()
        began = time.perf_counter()
        answer = self.peer.ask(self.name, image, info, (self.child,))
        return answer, 1e3 * (time.perf_counter() - began)

    def strike(self, frame: HostileFrame) -> None:
        """One hostile frame, and sometimes a good one after it."""
        self.verdicts.append(self.siege.strike(frame))
        if len(self.verdicts) % EVERY == 0:
            self.check()

    def check(self) -> None:
        """A good frame: how far its bodies are from the first ones, and how long it took."""
        answer, milliseconds = self._good()
        self.good[self.phase].append((difference(from_message(answer.message), self.first), milliseconds))
        self.memory.append(usage(self.child.pid).rss)

    def run(self, messages: int, number: int, masked: bool) -> None:
        """A share of the messages, after some good frames that nothing disturbs."""
        self.phase = "with masks" if masked else "without masks"
        if masked:
            # From now on somebody publishes masks, and a good frame without one is one that waits for it a moment.
            masks = self.peer.publisher(Image, "mask/image")
            until(masks.get_subscription_count, (self.child,))
        self.undisturbed[self.phase] = [self._good()[1] for _ in range(_UNDISTURBED)]
        self.good[self.phase] = []
        configured = settings(
            max_examples=messages,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        seed(number)(configured(given(frames(masked=masked))(self.strike)))()
        self.check()

    def result(self) -> dict[str, Any]:
        """Everything that was counted."""
        seen = len(self.reports)
        until(lambda: len(self.reports) > seen + 1, (self.child,))
        final = self.reports[-1]
        refused = [one for one in self.verdicts if not one.answered]
        distances = np.array([distance for found in self.good.values() for distance, _ in found])
        return {
            "messages": len(self.verdicts),
            "copies_sent": self.siege.sent,
            "answered": sum(one.answered for one in self.verdicts),
            "refused": len(refused),
            "without_reason": sum(not one.message for one in self.verdicts),
            "defects": Counter(one.message[:160] for one in self.verdicts if one.is_defect),
            "reasons": Counter(_NUMBERS.sub("#", one.message)[:160] for one in refused).most_common(60),
            "kinds": Counter(one.kind for one in refused).most_common(),
            "good_frames": len(distances),
            "good_frames_right": int((distances <= _SAME).sum()),
            "largest_difference_mm": float(1e3 * distances.max()),
            "good_ms": {name: report.spread(np.array(found)[:, 1]) for name, found in self.good.items()},
            "undisturbed_ms": {name: report.spread(np.array(found)) for name, found in self.undisturbed.items()},
            "published_results": len(self.answers),
            "balanced": final.is_balanced and final.count("in work") == 0,
            "counters": {key: final.count(key) for key in ("received", "answered", "dropped", "refused", "lost")},
            "memory_mb": [round(one, 1) for one in self.memory[:: max(1, len(self.memory) // 100)]],
        }


def main() -> None:
    parser = report.parser(__doc__, "hostile")
    parser.add_argument("--messages", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--node", choices=("recover_node", "fitter_node"), default="recover_node")
    options = parser.parse_args()
    with Peer() as peer, Children(environment()) as children:
        benchmark = Benchmark(options.node, peer, children)
        began = time.monotonic()
        for masked in (False, True):
            benchmark.run(options.messages // 2, options.seed + masked, masked)
        seconds = time.monotonic() - began
        result = benchmark.result()
        log = benchmark.child.last_lines()
    good, alone, counters = result["good_ms"], result["undisturbed_ms"], result["counters"]
    rows = [
        ["messages, minutes", f"{result['messages']}, {seconds / 60:.1f}"],
        ["the node lives", "yes"],
        ["good frames between them, right", f"{result['good_frames']}, {result['good_frames_right']}"],
        *([f"their time {name}, median / max ms; undisturbed",
           f"{good[name]['median']:.1f} / {good[name]['max']:.1f}; "
           f"{alone[name]['median']:.1f} / {alone[name]['max']:.1f}"] for name in good),
        ["answered, refused", f"{result['answered']}, {result['refused']}"],
        ["refused without a reason", str(result["without_reason"])],
        ["different reasons, kinds", f"{len(result['reasons'])}, {len(result['kinds'])}"],
        ["exceptions without a message of their own", str(sum(result["defects"].values()))],
        ["received = answered + dropped + refused",
         f"{'yes' if result['balanced'] else 'NO'}: " + ", ".join(f"{value} {key}" for key, value in counters.items())],
        ["results published", str(result["published_results"])],
        ["resident memory, first and last MB", f"{result['memory_mb'][0]:.0f}, {result['memory_mb'][-1]:.0f}"],
    ]  # fmt: skip
    lines = [[str(times), reason.replace("|", "/").replace("\n", " ")] for reason, times in result["reasons"]]
    reasons = report.table(["times", "reason, numbers and names as #"], lines)
    table = report.table(["", options.node], rows)
    report.write(options.name, {"options": vars(options), **result, "log": log}, f"{table}\n\n{reasons}")
    right = result["good_frames_right"] == result["good_frames"] and result["balanced"]
    sys.exit(0 if right and not result["defects"] and not result["without_reason"] else 1)


if __name__ == "__main__":
    main()
