"""References of parameters, made from what the nodes declare: a page for nodes on a robot, and YAML files of each.

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

from sq_perception.nodes.parameters import KINDS, FitterParameters, GraspParameters, RecoverParameters

PAGE = Path("docs/parameters.md")
COMMAND = "python docs_build/parameter_reference.py"

_HEAD = f"""\
# Parameters

Made by `{COMMAND}` from what the nodes declare; `ros2 param describe` says the same.

```sh
ros2 param set /recover_node s 100             # while it runs
ros2 run sq_perception recover_node --ros-args -p model:=supervised
ros2 run sq_perception recover_node --ros-args --params-file recover_node.yaml     # like the ones in config/
```

A value of another type, out of its range, or that does not fit the others is refused with a reason and changes nothing.

A change takes effect with the next frame, unless the meaning begins with *configure*: set while the node is
unconfigured (`ros2 lifecycle set /recover_node deactivate`, then `cleanup`), or with *start*: given at the start only.

After a change of `model`, `device`, `method` or `threads` frames go on as before until the new one is ready;
if it cannot be made the old one stays, and `/diagnostics` says why. Another `method` or model ends the tracks.

Quality of service is a parameter too, at the start only: `qos_overrides.<topic>.subscription.reliability`, `.depth`,
`.history`, or `.publisher.` and also `.durability`, with the topic as it is after remapping. recover_node takes it for
its inputs and for `~/superquadrics`, `~/markers`, `~/rendered_depth` and `~/support_plane`, synthetic_depth_node for
all its topics, grasp_node for `superquadrics`. The reliability of an input is `best_available` by default: reliable once
all publishers of the topic are, best effort while one is not.
"""


def page() -> str:
    """The page, Markdown."""
    other = f"fitter_node is recover_node with `method: {FitterParameters.method}`.\n"
    parts = [_HEAD, "## recover_node, recover_cameras, fitter_node\n", other]
    parts += [_table(fields(RecoverParameters), "configure")]
    parts += ["## grasp_node\n", _table(fields(GraspParameters), "start")]
    parts += ["## synthetic_depth_node\n", "See [its parameter file](../config/synthetic_depth_node.yaml).\n"]
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
            "# Inputs keep the last message and are as reliable as all publishers of their topic are;",
            "# qos_overrides./depth/image.subscription.reliability: best_effort, for instance, changes that (also .history",
            "# and .depth; the topic's name is the one after remapping).",
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
    lines = ["| name | default; range | meaning |", "|---|---|---|"]
    for one in rows:
        about = one.metadata
        when = "" if about["live"] else "*start*: " if one.name == "autostart" else f"*{otherwise}*: "
        values = "; ".join(filter(None, (_value(one.default), _range(one))))
        lines.append(f"| `{one.name}` | {values} | {when}{about['description']} |")
    return "\n".join(lines) + "\n"


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
        return "or " + ", ".join(f"`{choice}`" for choice in about["choices"] if choice != one.default)
    if about["within"] is not None:
        low, high = about["within"]
        whole = isinstance(one.default, int)
        return f"{low} to {high}{unit}" if whole else f"{low:g} to {high:g}{unit}"
    return unit.strip()


if __name__ == "__main__":
    main()
