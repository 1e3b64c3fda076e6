"""What a training run is made of, and where that is read from: a YAML file, the command line, or both.

A file holds fields of :class:`TrainingConfig` by name; what the command line gives wins.  Some travel with the package,
those of the shipped weights among them, and go by their name: ``sq-perception train --config robust``.  What a run is
made of is imported when it is made, so that the command's help need not wait for torch.

Learning rates over a run
-------------------------
    cosine     r = rate min(1, (k + 1) / warm_up) (1 + cos(pi p)) / 2        at step k, a share p of the run
    plateau    r is divided by 10 after every 10 validations without a better one, and the run ends after 20 without one

The plateau is the thesis' (chapter 5.3); its epoch is what lies between two validations here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sq_perception.learning.choices import LOSSES, UNSUPERVISED, Backbone, Framing

if TYPE_CHECKING:
    from sq_perception.learning.network_config import RegressorConfig

_SHIPPED = Path(__file__).with_name("configurations")
CHOICES: dict[str, tuple[str, ...]] = {
    "loss": LOSSES,
    "backbone": get_args(Backbone),
    "framing": get_args(Framing),
    "optimizer": ("adamw", "adam"),
    "schedule": ("cosine", "plateau"),
}
"""Fields that name something, and the names there are."""


def _setting(default: Any, meaning: str) -> Any:
    """A field of a run, whose meaning the command's help shows."""
    return field(default=default, metadata={"help": meaning})


@dataclass
class Plateau:
    """What the validations of a run have shown."""

    best: float = math.inf
    without_progress: int = 0
    reductions: int = 0

    @property
    def share(self) -> float:
        """By which the learning rate is multiplied."""
        return float(0.1**self.reductions)

    def record(self, loss: float) -> None:
        """Take note of a validation's loss."""
        if loss < self.best:
            self.best, self.without_progress = loss, 0
            return
        self.without_progress += 1
        if self.without_progress % 10 == 0:
            self.reductions += 1

    @property
    def exhausted(self) -> bool:
        """Whether nothing has become better for so long that the run should end."""
        return self.without_progress >= 20


@dataclass(frozen=True)
class Run(ABC):
    """What the training of any network is made of; defaults are those of the compact regressor."""

    start: str = _setting("", "A model file whose weights the network begins with; empty begins at random.")
    batch: int = _setting(128, "Views a step.")
    optimizer: str = _setting("adamw", "adamw, or adam as in the thesis.")
    schedule: str = _setting(
        "cosine",
        "cosine: warm up, then fall to 0; plateau: divide by 10 after 10 validations without progress, stop after 20.",
    )
    learning_rate: float = _setting(1.5e-3, "The largest learning rate.")
    weight_decay: float = _setting(1e-2, "For adamw; adam has none.")
    warm_up: int = _setting(400, "Steps over which the learning rate rises under the cosine schedule.")
    average: float = _setting(
        0.999, "The averaged weights keep this much of themselves at each step; they are what is validated and saved."
    )
    bfloat16: bool = _setting(
        True, "Compute the network in bfloat16 where it is safe and the device has it (automatic mixed precision)."
    )
    validation: int = _setting(1000, "Bodies in each validation set, and steps between validations.")
    seed: int = _setting(1, "Seed of the weights, the views and their order.")
    threads: int = _setting(
        0, "CPU threads of the network, and of the rendering of its views; 0 leaves both their own choice."
    )
    device: str = _setting("cpu", "cpu or cuda.")

    @abstractmethod
    def progress(self, step: int, seconds: float, plateau: Plateau) -> float:
        """Return the share of the run that is done, by its steps, its seconds and its validations."""

    def rate(self, step: int, progress: float, plateau: Plateau) -> float:
        """The learning rate of a step; see the module."""
        if self.schedule == "plateau":
            return self.learning_rate * plateau.share
        rise = min(1.0, (step + 1) / max(self.warm_up, 1))
        return self.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * progress))


@dataclass(frozen=True)
class TrainingConfig(Run):
    """A run of the regressor.  The defaults are those of the compact network under L_OC.  Raises ValueError for an
    unknown name, a number out of its range, or settings that contradict each other."""

    loss: str = _setting("occupancy", "What is minimised; the equations are in sq_perception/learning/losses.py.")
    backbone: str = _setting("compact", "compact, or resnet18 as in the thesis.")
    framing: str = _setting(
        "cropped", "What the network sees: cropped canonical views, or full frames of the unit cube as in the thesis."
    )
    pixels: int = _setting(
        64, "Side of the views: a multiple of 16 for compact, of 32 for resnet18; 256 in the thesis."
    )
    canonical_labels: bool = _setting(
        False, "List the axes of every label so that a1 >= a2; as drawn, their order is random."
    )
    pinhole_share: float = _setting(
        0.0, "Share of the views that a pinhole camera sees; the others are orthographic, as in the thesis."
    )
    wide_share: float = _setting(
        0.0, "Share of bodies with proportions up to 1 : 6; the others are those of the thesis' protocol."
    )
    occluded_share: float = _setting(0.0, "Share of the views with an occluder before the body.")
    noisy_share: float = _setting(0.0, "Share of the views with noise, steps, holes and wrong edges.")
    reuse: int = _setting(4, "How often a rendered view is used.")
    steps: int = _setting(20000, "Steps of the run; with the plateau schedule, the most it may take.")
    points: int = _setting(256, "Comparison points a body: half close around it, half in twice its box.")
    sharpness_start: float = _setting(
        0.0, "s of the loss at the start of the run, far basins first; 0 takes the loss's own value."
    )
    sharpness_end: float = _setting(0.0, "s of the loss at the end of the run.")
    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for names, expected, holds in (
            ("steps batch validation reuse", "at least 1", lambda v: v >= 1),
            ("points", "at least 2", lambda v: v >= 2),
            ("seed", "a number below 2^63 and of at least 0", lambda v: 0 <= v < 2**63),  # as torch takes them
            ("threads sharpness_start sharpness_end", "a finite number of at least 0", lambda v: 0 <= v < math.inf),
            ("pinhole_share wide_share occluded_share noisy_share", "a share from 0 to 1", lambda v: 0 <= v <= 1),
            ("learning_rate", "a positive number", lambda v: v > 0),
            ("average", "0 to below 1", lambda v: 0 <= v < 1),
        ):
            for name in names.split():
                if not holds(getattr(self, name)):
                    raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")
        if self.loss in UNSUPERVISED and (self.occluded_share or self.noisy_share):
            raise ValueError(f"{self.loss} takes each view as it is; occluders and noise need a loss with labels")
        if self.framing == "full" and (self.pinhole_share or self.occluded_share or self.noisy_share):
            raise ValueError("full frames are the thesis' images: orthographic, whole and clean")

    @property
    def marks_hidden(self) -> bool:
        """Whether the network learns what hidden pixels are; who uses it then looks for what hides."""
        return self.occluded_share > 0 or self.noisy_share > 0

    def regressor(self) -> RegressorConfig:
        """The network's form, unless ``start`` brings its own."""
        from sq_perception.learning.network_config import RegressorConfig

        form = RegressorConfig() if self.framing == "cropped" else RegressorConfig.thesis()
        changes = {"backbone": self.backbone, "pixels": self.pixels, "marks_hidden": self.marks_hidden}
        return replace(form, **changes)  # type: ignore[arg-type]

    def progress(self, step: int, seconds: float, plateau: Plateau) -> float:
        return 1.0 if self.schedule == "plateau" and plateau.exhausted else step / self.steps


@dataclass(frozen=True)
class ShardTraining(Run):
    """A run on views that a folder holds (:mod:`sq_perception.learning.shard_training`)."""

    batch: int = 64
    warm_up: int = 100
    average: float = 0.998  # some 500 steps
    bfloat16: bool = False
    validation: int = 200
    seed: int = 0
    minutes: float = 60.0  # training time, that of all parts of a stopped run together
    held: int = 2  # shards that are kept for validation

    def progress(self, step: int, seconds: float, plateau: Plateau) -> float:
        return seconds / (60 * self.minutes)


THING_RUN = ShardTraining(minutes=120.0, learning_rate=8e-4, weight_decay=1e-4)  # the network of things
MASK_RUN = ShardTraining(minutes=60.0, learning_rate=3e-3, weight_decay=1e-3)  # the network of masks


def read(path: str | Path, **changes: Any) -> TrainingConfig:
    """The configuration of a YAML file, or of a shipped one by its name, with ``changes`` made to it.  Raises
    ValueError if there is no such file, or it holds anything but fields of :class:`TrainingConfig`."""
    return TrainingConfig(**{**_values(path), **changes})


def shipped_names() -> list[str]:
    """Names of the configurations that travel with the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.yaml"))


def _values(path: str | Path) -> dict[str, Any]:
    from sq_perception.files.unpacking import UnpackingError, read_yaml  # NumPy, which --help needs not

    source = Path(path)
    if str(path) in shipped_names():
        source = _SHIPPED / f"{path}.yaml"
    if not source.is_file():
        raise ValueError(f"{path}: no such configuration file; shipped ones are {', '.join(shipped_names())}")
    try:
        values = read_yaml(source) or {}
    except UnpackingError as error:
        raise ValueError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected 'name: value' lines")
    known = {each.name: type(each.default) for each in fields(TrainingConfig)}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{path}: there is no setting {name!r}")
        wanted = known[name]
        # YAML 1.1 reads 1e-4 as text, and 1 is as good a number as 1.0.
        if wanted is float and isinstance(value, (int, str)) and not isinstance(value, bool):
            with suppress(ValueError):
                values[name] = value = float(value)
        if type(value) is not wanted:
            raise ValueError(f"{path}: {name}: expected {wanted.__name__}, got {value!r}")
    return values
