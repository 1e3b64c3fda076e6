"""What each numeric constant of fitting, segmentation and tracking decides: varied by 30 % to either side, by itself.

    python benchmarks/constants.py [--only fitting.problem tracking ...] [--kernels] [--name constants]

Constants are the numbers that modules of these rooms name in capitals, and the defaults of their options.  Every one is
multiplied by 0.7 and by 1.3 (whole numbers change at least by one, of numbers just below 1 what is missing to 1), and
its room's fixed set is done again:

    fitting       16 single bodies of the thesis (clean, noise 2, outliers, 30 % hidden; masks given), and 3 tables of
                  household things through a simulated sensor, masks given
    segmentation  the same tables, own masks
    tracking      20 recovered frames of a camera about a table, shown three times, 5.5 and 28 s apart; one body is
                  pushed, one slides, one is missed and one has no covariance; only tracking is done again

Printed are, for each of both sides, how many results are other ones to the bit, and the difference of the mean IoU
with the truth, per cent (tracking: of the mean error of the half sizes).  What changes nothing is used by no image of
so small a set, or by none at all.

A constant that compiled code reads is frozen in it.  With ``--kernels`` everything that reads it is compiled again, in
this process alone; without it these are passed over, as are names that are no quantities (columns, enumerations), and
numbers that are read when a module is loaded.  Results are written as they come; a run that was stopped goes on.
"""

from __future__ import annotations

if __name__ == "__main__":
    import one_thread  # noqa: F401

import ast
import dataclasses
import importlib
import math
import pkgutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from types import ModuleType
from typing import Any, NamedTuple

import household_things
import numpy as np
import report
import scene_verdict
import single_body
import torch
import tracking
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from tabletop import Tabletop

import sq_perception
from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric, metrics
from sq_perception.tracking.session import TrackingSession

FACTORS = (0.7, 1.3)
SCENES = (2, 5, 7)
"""Seeds: few things each, both sensors."""
DAMAGES = (None, single_body.noise(2), single_body.outliers, single_body.occluded)
BODIES = 4
FRAMES = 20
PASSES = (0.0, 5.5, 28.0)
"""Seconds between the end of a pass over the frames and the next one."""
PUSHED = np.array([0.04, 0.0, 0.0])
SLIDING = np.array([0.0, 0.0, 0.4])
"""Metres a second."""
FIXED = {
    "STEP_LENGTH": "a number of parameters",
    "LENGTH": "a number of parameters",
    "EXACT": "a number of forms",
    "LANES": "a length of vectors",
    "RAY_COLUMNS": "a number of columns",
    "_ROWS": "a number of rows",
    "_MEDIAN_TO_SIGMA": "of the normal distribution",
    "_EIGHTH_TURN": "an angle of symmetry",
    "CLASSIC": "a name",
    "SAMPSON": "a name",
    "RENDERED": "a name",
    "FIRST_FAILED_ID": "a name",
    "TURNS": "turns of a cube",
    "_QUATERNIONS": "turns of a cube",
    "_CHANGES": "turns of a cube",
    "_DIRECTIONS": "directions of a cube",
}
"""Numbers that cannot be varied."""


class Measured(NamedTuple):
    """The results of a fixed set: numbers that are compared to the bit, and one for how good they are."""

    results: list[bytes]
    quality: float


@dataclass(frozen=True)
class Constant:
    """A number of a module, or a default of one of its options."""

    room: str
    module: str
    name: str
    field: str = ""

    @property
    def key(self) -> str:
        return f"{self.room}.{self.module}.{self.name}" + (f".{self.field}" if self.field else "")

    @property
    def home(self) -> ModuleType:
        return importlib.import_module(f"sq_perception.{self.room}.{self.module}")

    @property
    def value(self) -> Any:
        holder = getattr(self.home, self.name)
        return getattr(holder, self.field) if self.field else holder

    def set(self, value: Any) -> None:
        """For all that read it from now on."""
        if self.field:
            holder = getattr(self.home, self.name)
            names = [each.name for each in dataclasses.fields(holder)]
            defaults = list(holder.__init__.__defaults__)
            defaults[names.index(self.field) - len(names)] = value
            holder.__init__.__defaults__ = tuple(defaults)
            setattr(holder, self.field, value)
            return
        before = self.value
        for module in _modules():
            if module is self.home or (self.name in _imported(module, self.home.__name__)):
                assert getattr(module, self.name) is before
                setattr(module, self.name, value)


def constants(room: str) -> Iterator[Constant]:
    """Those of a room, module by module."""
    folder = importlib.import_module(f"sq_perception.{room}")
    for module in sorted(each.name for each in pkgutil.iter_modules(folder.__path__)):
        home = importlib.import_module(f"sq_perception.{room}.{module}")
        for node in _tree(home).body:
            if isinstance(node, ast.Assign) and not ast.unparse(node.value).startswith("range"):
                for name in [each.id for each in ast.walk(node.targets[0]) if isinstance(each, ast.Name)]:
                    if name.strip("_").isupper() and _is_number(getattr(home, name)):
                        yield Constant(room, module, name)
            if isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
                for each in dataclasses.fields(getattr(home, node.name)):
                    if _is_number(each.default):
                        yield Constant(room, module, node.name, each.name)


def varied(value: Any, factor: float) -> Any:
    """The constant multiplied; whole numbers by at least one."""
    if isinstance(value, tuple):
        return tuple(varied(each, factor) for each in value)
    if isinstance(value, float) and 0.9 < value < 1:
        return 1 - (1 - value) / factor
    if isinstance(value, int):
        return max(0, min(round(factor * value), value - 1) if factor < 1 else max(round(factor * value), value + 1))
    return factor * value


def reason_to_pass(constant: Constant, kernels: bool) -> str:
    """Why it is not varied; empty if it is."""
    if constant.name in FIXED:
        return FIXED[constant.name]
    if constant.field:
        return ""
    if _read_when_loaded(constant.home, constant.name):
        return "read when its module is loaded"
    if not kernels and _frozen_in(constant):
        return "compiled in"
    return ""


# Fixed sets


@cache
def tables() -> tuple[Tabletop, ...]:
    return tuple(household_things.scene(seed, None) for seed in SCENES)


@cache
def single_images() -> list[tuple[Superquadric, single_body.Image]]:
    made = []
    for k, damage in enumerate(DAMAGES):
        rng = np.random.default_rng([41, k])
        for body in single_body.cube_bodies(BODIES, rng):
            image = single_body.orthographic(body)
            made.append((body, damage(image, rng) if damage else image))
    return made


def of_tables(own: bool) -> Measured:
    """Every thing of the tables; one that is missed or failed has an IoU of 0."""
    results, ious = [], []
    for scene in tables():
        frame = scene_verdict.recoverer().recover(scene.depth, scene.camera, None if own else scene.labels)
        matches = scene_verdict.matches(frame.labels, scene.labels) if own else {}
        for placed in scene.placed:
            label = matches.get(placed.label, 0) if own else placed.label
            answer = scene_verdict.of_frame(frame, label, placed, scene)
            ious.append(answer.iou)
            results.append(answer.body.tobytes() + answer.status.encode() + answer.message.encode())
        if own:
            results.append(frame.labels.tobytes())
    return Measured(results, 100 * float(np.mean(ious)))


def of_single_images() -> Measured:
    fits = [surface_fit.fit(image.depth, image.mask, image.camera) for _, image in single_images()]
    bodies = Superquadric.stack([fit.superquadric for fit in fits])
    iou = metrics.volume_iou(bodies, Superquadric.stack([body for body, _ in single_images()]))
    iou *= np.array([fit.status != Status.FAILED for fit in fits])
    results = [fit.superquadric.to_flat().tobytes() + fit.covariance.tobytes() + fit.message.encode() for fit in fits]
    return Measured(results, 100 * float(iou.mean()))


class Seen(NamedTuple):
    """What a tracker is given."""

    superquadric: Superquadric
    covariance: np.ndarray
    repeats: int = 0


@cache
def tracked_frames() -> list[tuple[tracking.View, list[Seen], list[Superquadric]]]:
    """Frames with their observations and the true body of each."""
    (shown,) = tracking.scenes(1, 1)
    recoverer, made = scene_verdict.recoverer(), []
    for k, view in enumerate(tracking.views(shown, tracking.ROWS["moving"], FRAMES, np.random.default_rng(3))):
        frame = recoverer.recover(view.depth, view.scene.camera, view.labels)
        seen, truths = [], []
        for one in frame.recovered:
            body, truth, covariance = one.superquadric, view.scene.bodies[one.label - 1], one.covariance
            if one.label == 1 and k >= 8:  # pushed
                body, truth = (each.transformed(np.array([0.0, 0, 0, 1]), PUSHED) for each in (body, truth))
            if one.label == 4 and k >= 5:
                by = SLIDING * (min(k, 15) - 5) / tracking.RATE
                body, truth = (each.transformed(np.array([0.0, 0, 0, 1]), by) for each in (body, truth))
            if one.label == 2 and 10 <= k < 17:  # not recovered, and in the last of these frames not there
                continue
            if one.label == 3 and k % 2:
                covariance = np.full_like(covariance, np.nan)
            seen.append(Seen(body, covariance))
            truths.append(truth)
        depth = np.where((view.labels == 2) & (12 <= k < 17), view.depth + 1.0, view.depth)
        made.append((dataclasses.replace(view, depth=depth), seen, truths))
    return made


def of_tracked_frames() -> Measured:
    """Quality is the mean error of half sizes, per cent."""
    session, results, errors, stamp = TrackingSession(), [], [], 0.0
    for number, gap in enumerate(PASSES):
        stamp += gap
        for view, seen, truths in tracked_frames():
            stamp += 1 / tracking.RATE
            shown = seen[number:]  # in later passes some are missed for good
            followed = session.follow(shown, stamp, view.pose, camera=view.scene.camera, depth=view.depth)
            for one, truth in zip(followed, truths[number:], strict=True):
                results.append(one.superquadric.to_flat().tobytes() + one.covariance.tobytes() + str(one.id).encode())
                errors.append(np.abs(tracking.size_errors(one.superquadric, truth)[0]).mean())
            results.append(str(session.hidden).encode())
    return Measured(results, 100 * float(np.mean(errors)))


SETS: dict[str, dict[str, Callable[[], Measured]]] = {
    "fitting": {"single bodies": of_single_images, "things": partial(of_tables, False)},
    "segmentation": {"things": partial(of_tables, True)},
    "tracking": {"tracked": of_tracked_frames},
}


def compared(now: Measured, usual: Measured) -> dict[str, float]:
    """The share of results that are other ones, and how much better they are."""
    same = sum(one == other for one, other in zip(now.results, usual.results, strict=False))
    return {"changed": 1 - same / len(usual.results), "difference": now.quality - usual.quality}


# Where constants are read


@cache
def _modules() -> tuple[ModuleType, ...]:
    return tuple(module for name, module in sys.modules.items() if name.startswith("sq_perception.") and module)


@cache
def _tree(module: ModuleType) -> ast.Module:
    assert module.__file__ is not None
    with open(module.__file__, encoding="utf-8") as file:
        return ast.parse(file.read())


@cache
def _imported(module: ModuleType, home: str) -> frozenset[str]:
    """The names that a module imports from another one."""
    found = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom) and node.module == home]
    return frozenset(alias.name for node in found for alias in node.names)


def _read_when_loaded(home: ModuleType, name: str) -> bool:
    """Whether a module uses its constant outside of functions."""

    def outside(node: ast.AST) -> Iterator[ast.AST]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.Lambda)):
                yield from (part for default in child.args.defaults for part in ast.walk(default))
            else:
                yield child
                yield from outside(child)

    return any(isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Load) for n in outside(_tree(home)))


@cache
def _dispatchers() -> frozenset[Dispatcher]:
    return frozenset(one for module in _modules() for one in vars(module).values() if isinstance(one, Dispatcher))


@cache
def _called_by(kernel: Dispatcher) -> frozenset[Dispatcher]:
    known = kernel.py_func.__globals__
    called = (known.get(name) for name in kernel.py_func.__code__.co_names)
    return frozenset(one for one in called if isinstance(one, Dispatcher))


def _frozen_in(constant: Constant) -> set[Dispatcher]:
    """Compiled functions that read a constant, and those that call these."""
    homes = [constant.home.__name__]
    homes += [one.__name__ for one in _modules() if constant.name in _imported(one, constant.home.__name__)]
    near = [one for one in _dispatchers() if one.py_func.__module__ in homes]
    found = {one for one in near if constant.name in one.py_func.__code__.co_names}
    while True:
        callers = {one for one in _dispatchers() if found & _called_by(one)}
        if callers <= found:
            return found
        found |= callers


def _forget(kernels: set[Dispatcher]) -> None:
    """Compile these anew when they are called next; nothing is read from or written to the disk."""
    for one in kernels:
        one._make_finalizer()()
        one._reset_overloads()
        one._cache = NullCache()


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(map(_is_number, value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "f"
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value != 0


# The run


def row(constant: Constant, usual: dict[str, Measured]) -> dict[str, Any]:
    """What both sides of a constant change, by part of the fixed set."""
    value, frozen = constant.value, _frozen_in(constant) if not constant.field else set()
    found: dict[str, Any] = {"value": np.asarray(value).tolist(), "sides": {}}
    for factor in FACTORS:
        other = varied(value, factor)
        _forget(frozen)
        constant.set(other)
        try:
            sides = {part: compared(run(), usual[part]) for part, run in SETS[constant.room].items()}
        except Exception as error:  # what a value makes impossible is reported, and the next one's turn comes
            sides = {"error": f"{type(error).__name__}: {error}".splitlines()[0]}
        finally:
            constant.set(value)
        found["sides"][str(factor)] = sides
    _forget(frozen)
    return found


def line(key: str, found: dict[str, Any]) -> list[str]:
    """A row of the table."""
    if "passed" in found:
        return [key, found["shown"], found["passed"], ""]
    cells = []
    for sides in found["sides"].values():
        if "error" in sides:
            cells.append(sides["error"])
            continue
        cells.append(
            "; ".join(f"{part}: {100 * one['changed']:.0f} %, {one['difference']:+.2f}" for part, one in sides.items())
        )
    return [key, found["shown"], *cells]


def text(result: dict[str, Any]) -> str:
    """The table, and what changed nothing."""
    header = ["constant", "value", *(f"x {factor}: results changed, quality" for factor in FACTORS)]
    rows = [line(key, found) for key, found in sorted(result.items())]
    idle = [key for key, found in sorted(result.items()) if "sides" in found and _is_idle(found)]
    return report.table(header, rows) + f"\n\nChanged nothing: {', '.join(idle) or 'none'}"


def _is_idle(found: dict[str, Any]) -> bool:
    sides = [one for each in found["sides"].values() for one in each.values()]
    return all(isinstance(one, dict) and one["changed"] == 0 for one in sides)


def main() -> None:
    parser = report.parser(__doc__, "constants")
    parser.add_argument("--only", nargs="+", default=list(SETS), help="rooms, or modules as room.module")
    parser.add_argument("--kernels", action="store_true", help="those too that compiled code has frozen in (hours)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene_verdict.recoverer().warm_up(tables()[0].camera)
    for module in pkgutil.walk_packages(sq_perception.__path__, "sq_perception."):
        if module.name.split(".")[1] in SETS:
            importlib.import_module(module.name)
    result: dict[str, Any] = report.previous(options.name, "constants")
    usual: dict[str, dict[str, Measured]] = {}
    for room in SETS:
        for constant in constants(room):
            wanted = any(f"{constant.key}.".startswith(f"{each}.") for each in options.only)
            if not wanted or "sides" in result.get(constant.key, {}):
                continue
            values = np.asarray(constant.value).ravel()
            values = np.unique(values) if values.size > 4 else values
            shown = " ".join(f"{x:.4g}" for x in values)
            passed = reason_to_pass(constant, options.kernels)
            if passed:
                found: dict[str, Any] = {"shown": shown, "passed": passed}
            else:
                if room not in usual:
                    usual[room] = {part: run() for part, run in SETS[room].items()}
                found = {"shown": shown, **row(constant, usual[room])}
            result[constant.key] = found
            print(" | ".join(line(constant.key, found)), flush=True)
            facts = {"options": vars(options), "factors": FACTORS}
            report.write(options.name, {**facts, "constants": result}, text(result), shown=False)


if __name__ == "__main__":
    main()
