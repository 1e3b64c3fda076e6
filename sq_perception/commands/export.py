"""``sq-perception export``: a network as an ONNX graph."""

from __future__ import annotations

from collections.abc import Sequence

from sq_perception.commands.console import SUCCESS, failed, parser, target
from sq_perception.files import output_file

_HELP = "Write a network as ONNX: views (n, 1, p, p) in, the 12 parameters of n bodies out."
_EPILOG = "example:\n  sq-perception export --model supervised --output network.onnx"


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception export``; the exit code."""
    command = parser("export", _HELP, _EPILOG)
    command.add_argument("--model", metavar="FILE", help="weights: a .safetensors file, or the name of shipped ones")
    command.add_argument("--output", "-o", type=target, required=True, metavar="FILE", help="the .onnx file")
    options = command.parse_args(arguments)

    from sq_perception.learning import checkpoint

    path = checkpoint.resolve(options.model)
    try:
        from sq_perception.learning.onnx_export import build

        content = build(checkpoint.load(path), checkpoint.read_header(path)).SerializeToString()
        output_file.write(options.output, content)
    except ModuleNotFoundError as error:
        return failed(f"export needs the module {error.name!r}: pip install 'sq_perception[export]'")
    except (checkpoint.CheckpointError, OSError) as error:
        return failed(f"export: {error}")
    return SUCCESS
