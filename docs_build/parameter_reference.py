"""Write config/*.yaml, the reference of the parameters, from what the nodes declare.

    python docs_build/parameter_reference.py

The dataclasses of the nodes hold the defaults; a test compares the files with them.
"""

from __future__ import annotations

import json
import textwrap
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from sq_perception.nodes.grasp_node import GraspParameters
from sq_perception.nodes.parameters import FitterParameters, Parameters, RecoverParameters
from sq_perception.nodes.synthetic_depth_node import SyntheticParameters

KINDS: dict[str, type[Parameters]] = {
    "recover_node": RecoverParameters,
    "fitter_node": FitterParameters,
    "grasp_node": GraspParameters,
    "synthetic_depth_node": SyntheticParameters,
}


def yaml_text(name: str) -> str:
    """Return the parameter file of a node: every default below its description."""
    kind = KINDS[name]
    lines = [
        f"# Parameters of {name} with their defaults: start it with --ros-args --params-file <this file>.",
        f"# Those marked live can change at run time: ros2 param set /{name} <name> <value>.  See docs/nodes.md.",
    ]
    lines += ["/**:", "  ros__parameters:"]
    for one in fields(kind):
        choices = one.metadata["choices"]
        remarks = [f"one of {', '.join(choices)}" if choices else _range(one).strip()]
        remarks += ["live"] if one.metadata["live"] else []
        remark = "; ".join(filter(None, remarks))
        text = one.metadata["description"] + (f" [{remark}]" if remark else "")
        lines += textwrap.wrap(text, 120, initial_indent="    # ", subsequent_indent="    # ", break_on_hyphens=False)
        lines.append(f"    {one.name}: {json.dumps(one.default)}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the files."""
    root = Path(__file__).resolve().parent.parent
    for name in KINDS:
        (root / "config" / f"{name}.yaml").write_text(yaml_text(name), encoding="utf-8")


def _range(one: Field[Any]) -> str:
    about = one.metadata
    unit = f" {about['unit']}" if about["unit"] else ""
    if about["within"] is not None:
        low, high = about["within"]
        whole = isinstance(one.default, int)
        return f"{low} to {high}{unit}" if whole else f"{low:g} to {high:g}{unit}"
    return unit.strip()


if __name__ == "__main__":
    main()
