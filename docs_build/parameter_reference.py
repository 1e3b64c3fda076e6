"""The reference of every parameter, made from what the nodes declare: a page for people and YAML files for launches.

    python docs_build/parameter_reference.py       # docs/parameters.md and config/*.yaml

One truth: the dataclasses of :mod:`sq_perception.nodes.parameters`.  A test holds the files to them.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from sq_perception.nodes.parameters import (
    KINDS,
    FitterParameters,
    GraspParameters,
    RecoverParameters,
    SyntheticParameters,
)

PAGE = Path("docs/parameters.md")
COMMAND = "python docs_build/parameter_reference.py"

_HEAD = f"""\
# Parameters

Made by `{COMMAND}` from what the nodes declare; `ros2 param describe /recover_node s` tells the same.

```sh
ros2 param set /recover_node s 100             # while it runs; an integer is as good as 100.0
ros2 run sq_perception recover_node --ros-args -p s:=100 -p model:=supervised
ros2 run sq_perception recover_node --ros-args --params-file recover_node.yaml     # like the ones in config/
```

**Changes**: "live" parameters take effect with the next frame. Those that say "configure" are read when the node is
configured; they are refused with the reason while it is up, and may be set while it is unconfigured
(`ros2 lifecycle set /recover_node deactivate`, then `cleanup`). Those that say "start" are given at the start only. A
value out of its range, of another type or that does not fit the others is refused with a reason and changes nothing.

`model`, `device`, `method`, `consensus` and `threads` change what computes: the new one is made beside the work and
swapped when it is warm; one that cannot be made leaves the old one at work, and `/diagnostics` says why. A model file
is checked before the change is accepted. Setting the same file again reads it again.

The quality of service of each subscription, and of the cloud, markers and rendered depth, is a parameter too, at the
start only: `qos_overrides.<topic>.subscription.reliability`, `.depth`, `.history`, or `.publisher.` and also
`.durability`, with the topic as it is after remapping, such as `/camera/camera/depth/image_rect_raw`. So
`qos_overrides./recover_node/superquadrics.publisher.durability: transient_local` keeps the last cloud for late comers.
`use_sim_time` is that of every ROS 2 node.
"""


def page() -> str:
    """The page, Markdown."""
    other = f"fitter_node is recover_node with `method: {FitterParameters.method}`.\n"
    parts = [_HEAD, "## recover_node, recover_cameras, fitter_node\n", other]
    parts += [_table(fields(RecoverParameters), "configure")]
    parts += ["## grasp_node\n", _table(fields(GraspParameters), "start")]
    parts += ["## synthetic_depth_node\n", _table(fields(SyntheticParameters), "start")]
    return "\n".join(parts)


def yaml_text(name: str) -> str:
    """A parameter file of a node with every default, each below its description."""
    kind = KINDS[name]
    lines = [
        f"# Parameters of {name} with their defaults: start it with --ros-args --params-file <this file>.",
        f"# Those marked live also change while the node runs: ros2 param set /{name} <name> <value>.",
    ]
    if issubclass(kind, RecoverParameters):
        lines += [
            "# Inputs are best effort, keep last 1; qos_overrides./depth/image.subscription.reliability: reliable, for",
            "# instance, changes that (also .history and .depth; the topic's name is the one after remapping).",
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
    """Write the page and the files."""
    root = Path(__file__).resolve().parent.parent
    (root / PAGE).write_text(page(), encoding="utf-8")
    for name in KINDS:
        (root / "config" / f"{name}.yaml").write_text(yaml_text(name), encoding="utf-8")


def _table(rows: Sequence[Field[Any]], otherwise: str) -> str:
    lines = ["| name | type | default | range | change | meaning |", "| --- | --- | --- | --- | --- | --- |"]
    for one in rows:
        about = one.metadata
        when = "live" if about["live"] else "start" if one.name == "autostart" else otherwise
        lines.append(
            f"| `{one.name}` | {_kind(one)} | {_value(one.default)} | {_range(one)} | {when} | {about['description']} |"
        )
    return "\n".join(lines) + "\n"


def _kind(one: Field[Any]) -> str:
    return {float: "double or integer", int: "integer", bool: "bool", str: "string", tuple: "6 doubles"}[
        type(one.default)
    ]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value}`" if value != "" else "empty"


def _range(one: Field[Any]) -> str:
    about = one.metadata
    unit = f" {about['unit']}" if about["unit"] else ""
    if about["choices"]:
        return ", ".join(f"`{choice}`" for choice in about["choices"])
    if about["within"] is not None:
        low, high = about["within"]
        whole = isinstance(one.default, int)
        return f"{low} to {high}{unit}" if whole else f"{low:g} to {high:g}{unit}"
    return unit.strip()


if __name__ == "__main__":
    main()
