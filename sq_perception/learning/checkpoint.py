"""Network weights on disk: safetensors with a header that describes them.

What a file holds is read into NumPy arrays; torch is imported where one of its modules is made or written.

The header (strings, as the format demands) holds ``format`` and its version, the network's ``config`` and whatever the
training noted (``training``, ``metrics``: JSON).  Reading executes nothing, and every name and shape must fit.
Half precision on disk halves the file; networks compute in single precision.

Weights are read as a whole and never mapped: a file that is cut short or replaced meanwhile is an error or another
network, and no fault of memory that ends the process.  The file's own length bounds what is allocated.

Reference: the safetensors format, https://huggingface.co/docs/safetensors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load as arrays_of
from safetensors.numpy import save as bytes_of

from sq_perception.files import output_file
from sq_perception.learning import layout
from sq_perception.learning.network_config import MaskConfig, RegressorConfig, ThingConfig

if TYPE_CHECKING:
    import torch

    from sq_perception.learning.networks import MaskNetwork, Regressor, ThingNetwork

FORMAT, THING_FORMAT, MASK_FORMAT = "sq_perception.regressor", "sq_perception.things", "sq_perception.masks"
_FORMATS: dict[type[Any], str] = {RegressorConfig: FORMAT, ThingConfig: THING_FORMAT, MaskConfig: MASK_FORMAT}
Config = TypeVar("Config", RegressorConfig, ThingConfig, MaskConfig)
VERSION = "1"
DEFAULT = "robust"  # name of the weights that predict a body where none are named
_SHIPPED: dict[type[Any], str] = {RegressorConfig: DEFAULT, ThingConfig: "things", MaskConfig: "masks"}
"""Names of the weights that are used where none are named."""
_MAX_PARAMETERS = 200_000_000


class CheckpointError(ValueError):
    """A weights file that is missing, damaged, or of another kind; the message names which."""


def shipped_weights() -> dict[str, Path]:
    """The weights that ship with the package, by name."""
    folder = Path(str(resources.files("sq_perception") / "weights"))
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def shipped_regressors() -> dict[str, Path]:
    """The weights that ship with the package and predict a body, by name."""
    return {name: path for name, path in shipped_weights().items() if read_header(path).get("format") == FORMAT}


def resolve(model: Path | str | None = None) -> Path:
    """The file that is meant by a path, by the name of shipped weights, or by None: those for real cameras."""
    if model is None:
        model = DEFAULT
    path = Path(model)
    return path if path.suffix else shipped_weights().get(str(model), path)


def save(
    path: Path | str, model: Regressor | ThingNetwork | MaskNetwork, notes: dict[str, Any] | None = None,
    dtype: type[np.floating[Any]] = np.float16,
) -> None:
    """Write a network and ``notes`` (JSON values) to ``path``; replaced at once, never half written."""
    path = Path(path)
    state = {}
    for name, tensor in model.state_dict().items():
        array = tensor.detach().cpu().numpy()
        state[name] = np.ascontiguousarray(array, dtype if array.dtype.kind == "f" else None)
    header = {"format": _FORMATS[type(model.config)], "version": VERSION, "config": json.dumps(asdict(model.config))}
    header.update({key: json.dumps(value) for key, value in (notes or {}).items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    output_file.write(path, bytes_of(state, metadata=header))


def load(path: Path | str | None = None, device: str | torch.device = "cpu") -> Regressor:
    """A network as a module of torch, in evaluation mode; path and errors as of :func:`read`."""
    from sq_perception.learning.networks import Regressor

    return _module(Regressor, *read(RegressorConfig, path)).to(device).eval()


def load_things(path: Path | str | None = None, device: str | torch.device = "cpu") -> ThingNetwork:
    """The network of things, None for the one that ships; otherwise as :func:`load`."""
    from sq_perception.learning.networks import ThingNetwork

    return _module(ThingNetwork, *read(ThingConfig, path)).to(device).eval()


def load_masks(path: Path | str | None = None) -> MaskNetwork:
    """The network of masks on the cpu, None for the one that ships; otherwise as :func:`load`."""
    from sq_perception.learning.networks import MaskNetwork

    return _module(MaskNetwork, *read(MaskConfig, path)).eval()


def _module(kind: Any, config: RegressorConfig | ThingConfig | MaskConfig, weights: Mapping[str, np.ndarray]) -> Any:
    import torch

    with torch.device("meta"):
        model = kind(config)
    model.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()}, assign=True)
    return model


def read(kind: type[Config], path: Path | str | None = None) -> tuple[Config, dict[str, np.ndarray]]:
    """The form of a network and its float32 weights by name; the path is as :func:`resolve` takes it, None for the
    shipped ones of this kind.  Raises CheckpointError if the file is missing, of another kind, or does not fit its
    config."""
    path = resolve(_SHIPPED[kind] if path is None else path)
    config = _parse_config(path, read_header(path), kind)
    try:
        stored = arrays_of(path.read_bytes())
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: not a readable safetensors file: {error}") from error
    expected = layout.shapes(config)
    found = {name: array for name, array in stored.items() if not name.endswith(layout.COUNTER)}
    weights = {}
    for name in sorted(expected.keys() | found.keys()):
        array = found.get(name)
        if array is None or array.shape != expected.get(name) or array.dtype.kind != "f":
            wanted = f"numbers of shape {expected[name]}" if name in expected else "no such weights"
            given = "none" if array is None else f"{array.dtype} {array.shape}"
            raise CheckpointError(f"{path}: the weights do not fit the config: {name}: expected {wanted}, got {given}")
        weights[name] = array.astype(np.float32)
        if not np.isfinite(weights[name]).all():
            raise CheckpointError(f"{path}: the weights are not all finite")
    return config, weights


def read_header(path: Path | str | None = None) -> dict[str, str]:
    """The header's strings alone; raises CheckpointError as :func:`load` does, but looks at no weights."""
    path, most = resolve(path), 4 * _MAX_PARAMETERS + 2**20
    try:
        if not path.is_file():
            raise CheckpointError(f"{path}: no such model file")
        if path.stat().st_size > most:
            raise CheckpointError(f"{path}: expected at most {most} bytes, got {path.stat().st_size}")
        with safe_open(path, "np") as file:
            return dict(file.metadata() or {})
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error
    except SafetensorError as error:
        raise CheckpointError(f"{path}: not a readable safetensors file: {error}") from error


def predicts_hulls(path: Path | str | None = None) -> bool:
    """Whether a file holds a network of things; raises CheckpointError where it holds no header."""
    return path is not None and read_header(path).get("format") == THING_FORMAT


def check(path: Path | str | None = None) -> None:
    """Raise CheckpointError where :func:`load` or :func:`load_things` would because of the header."""
    path = resolve(path)
    header = read_header(path)
    kind: type[Any] = ThingConfig if header.get("format") == THING_FORMAT else RegressorConfig
    _parse_config(path, header, kind)


def _parse_config(path: Path, header: dict[str, str], kind: type[Config]) -> Config:
    """The form that a header describes; CheckpointError if it describes none."""
    if header.get("format") != _FORMATS[kind]:
        raise CheckpointError(f"{path}: expected a header 'format: {_FORMATS[kind]}', got {header.get('format')!r}")
    if header.get("version") != VERSION:
        raise CheckpointError(f"{path}: expected format version {VERSION}, got {header.get('version')!r}")
    try:
        values: dict[str, Any] = json.loads(header["config"])
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
        config = kind(**values)
        if config.pixels > 1024 or config.blocks > 64:
            raise ValueError("expected at most 1024 pixels and 64 blocks a stage")
        if sum(math.prod(shape) for shape in layout.shapes(config).values()) > _MAX_PARAMETERS:
            raise ValueError("the network would be larger than any this package trains")
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: the header's config describes no network: {error}") from error
    return config
