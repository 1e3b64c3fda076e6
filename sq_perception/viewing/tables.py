"""Numbers and texts of the page, as HTML: a table of bodies, the state of a node, the legend of the colours.

Half sizes in millimetres, or thousandths of the unit cube, with their standard deviations.  Every text that comes from
outside is escaped.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from sq_perception.viewing.drawings import Bodies, colour_scale

SILENT_SECONDS = 3.0
"""A node without results for so long is called silent."""
_GOOD, _OPEN, _BAD, _DIM = "#51cf66", "#fcc419", "#ff6b6b", "#909296"
_NUMBERS = "font-variant-numeric:tabular-nums;text-align:right;padding:3px 5px;white-space:nowrap"
_HEAD = f"font-weight:600;color:{_DIM};text-align:right;padding:2px 5px;white-space:nowrap"
_SMALL = f"font-size:0.85em;color:{_DIM}"
_TABLE = "font-size:12.5px;line-height:1.25;border-collapse:collapse;width:100%"
_MOST_FAILED = 5


@dataclass(frozen=True)
class NodeState:
    """How a node is doing, as far as it is known here.

    Attributes
    ----------
    age
        Seconds since its last result came; None if none ever did.
    diagnostics
        Key and value of its last diagnostics.
    is_there
        Whether its services answer.
    remark
        Why its bodies are not drawn; empty if they are.
    """

    name: str
    age: float | None = None
    diagnostics: Mapping[str, str] = field(default_factory=dict)
    is_there: bool = False
    remark: str = ""

    @property
    def is_silent(self) -> bool:
        return self.age is None or self.age > SILENT_SECONDS


def bodies_table(bodies: Bodies | None, state: NodeState, *, is_cube: bool = False) -> str:
    """The bodies of a node; ``is_cube`` if their image shows the unit cube."""
    if bodies is None:
        return f'<div style="padding:4px 17px;font-size:12.5px;color:{_DIM}">No result has come yet.</div>'
    faded = ";opacity:0.45" if state.is_silent else ""
    rows = []
    for k, body in enumerate(bodies.superquadrics):
        red, green, blue = (round(255 * float(channel)) for channel in bodies.colours[k])
        chip = (
            f'<span style="display:inline-block;width:10px;height:10px;border-radius:3px;margin-right:5px;'
            f'background:rgb({red},{green},{blue})"></span>'
        )
        cells = [f'<td style="{_NUMBERS};text-align:left">{chip}<b>{bodies.ids[k]}</b></td>']
        cells += [_size(float(a), float(sigma)) for a, sigma in zip(body.size, bodies.sigma_size[k], strict=True)]
        cells.append(f'<td style="{_NUMBERS}">{body.shape[0]:.2f}<br>{body.shape[1]:.2f}</td>')
        cells.append(f'<td style="{_NUMBERS}">{float(bodies.score[k]):.2f}</td>')
        colour, status = (_OPEN, "weak") if bodies.is_weak[k] else (_GOOD, "good")
        cells.append(f'<td style="{_NUMBERS};color:{colour}">{status}</td>')
        rows.append(f'<tr style="border-top:1px solid rgba(128,128,128,0.25)">{"".join(cells)}</tr>')
    titles = ("id", "a<sub>1</sub>", "a<sub>2</sub>", "a<sub>3</sub>", "e<sub>1</sub> e<sub>2</sub>", "score", "fit")
    head = "".join(
        f'<th style="{_HEAD}{";text-align:left" if k == 0 else ""}">{title}</th>' for k, title in enumerate(titles)
    )
    count = len(bodies)
    heading = f"{count} {'body' if count == 1 else 'bodies'}" if count else "no bodies"
    unit = "thousandths of the cube" if is_cube else "mm"
    failed = ""
    if bodies.failed:
        shown = ", ".join(str(number) for number in bodies.failed[:_MOST_FAILED])
        more = f" and {len(bodies.failed) - _MOST_FAILED} more" if len(bodies.failed) > _MOST_FAILED else ""
        failed = f'<div style="color:{_BAD};padding:3px 5px">no fit: {shown}{more}</div>'
    table = f'<table style="{_TABLE}"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return (
        f'<div data-node="{html.escape(state.name)}" style="padding:2px 12px 6px 12px{faded}">'
        f'<div style="{_SMALL};padding:2px 5px">{heading}; half sizes in {unit} ± standard deviation</div>'
        f'<div style="overflow-x:auto;overflow-y:auto;max-height:340px">{table if count else ""}</div>{failed}</div>'
    )


def node_status(state: NodeState) -> str:
    """One node in a few lines: is it there, how fast, how late, what was lost, what went wrong last."""
    colour, text = _verdict(state)
    values = state.diagnostics
    rate = values.get("rate [Hz]")
    median, high = values.get("stamp to result: median [ms]"), values.get("stamp to result: p95 [ms]", "-")
    counts = (key for key in ("received", "answered", "dropped", "refused", "lost") if key in values)
    facts = {
        "rate": f"{_rounded(rate, 1)} Hz" if rate else "",
        "stamp to result": f"{_rounded(median)} ms, p95 {_rounded(high)} ms" if median else "",
        "frames": ", ".join(f"{html.escape(values[key])} {key}" for key in counts),
        "tracks": html.escape(values.get("tracks", "")),
        "last error": _coloured(_OPEN, values.get("last error", "")),
        "not drawn": _coloured(_BAD, state.remark),
    }
    rows = "".join(
        f'<tr><td style="color:{_DIM};padding:1px 10px 1px 0;vertical-align:top;white-space:nowrap">{key}</td>'
        f'<td style="padding:1px 0;overflow-wrap:anywhere">{value}</td></tr>'
        for key, value in facts.items()
        if value
    )
    return (
        f'<div style="padding:4px 12px"><div>{_coloured(colour, "●")} <b>{html.escape(state.name)}</b> '
        f"{_coloured(colour, text)}</div>"
        f'<table style="font-size:12.5px;line-height:1.35;margin-left:14px">{rows}</table></div>'
    )


def source_status(topic: str, size: tuple[int, int] | None, rate: float, frame: str, remark: str) -> str:
    """Where the depth comes from; ``rate`` in images per second."""
    text = f"{size[0]} × {size[1]}, {rate:.1f} Hz, {frame or 'no frame_id'}" if size and not remark else remark
    colour = _GOOD if size and not remark else _OPEN
    return (
        f'<div style="padding:4px 12px">{_coloured(colour, "●")} <b>{html.escape(topic)}</b><br>'
        f'<span style="font-size:12.5px;margin-left:14px;color:{_DIM}">{html.escape(text)}</span></div>'
    )


def legend(span: tuple[float, float], unit: str = "m") -> str:
    """The scale of the colours of depth."""
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colour_scale())
    near, far = (f"{value:.2f} {unit}".strip() for value in span)
    return (
        f'<div style="padding:0 12px 6px 12px;font-size:12px;color:{_DIM}">'
        f'<div style="height:8px;border-radius:4px;background:linear-gradient(to right,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{near}</span><span>depth</span>'
        f"<span>{far}</span></div></div>"
    )


def answer(text: str, good: bool) -> str:
    """The answer of a node to a change."""
    if not text:
        return ""
    colour = _GOOD if good else _BAD
    return (
        f'<div style="margin:2px 12px 6px 12px;padding:6px 9px;border-left:3px solid {colour};'
        f'background:rgba(128,128,128,0.12);font-size:12.5px;overflow-wrap:anywhere">{html.escape(text)}</div>'
    )


def _coloured(colour: str, text: str) -> str:
    return f'<span style="color:{colour}">{html.escape(text)}</span>' if text else ""


def _size(half: float, sigma: float) -> str:
    digits = 1 if half < 1.0 else 0
    deviation = f"±{1e3 * sigma:.{1 if sigma < 0.01 else 0}f}" if math.isfinite(sigma) else "± ?"
    return f'<td style="{_NUMBERS}">{1e3 * half:.{digits}f}<br><span style="{_SMALL}">{deviation}</span></td>'


def _rounded(text: str, digits: int = 0) -> str:
    try:
        return f"{float(text):.{digits}f}"
    except ValueError:
        return html.escape(text)


def _verdict(state: NodeState) -> tuple[str, str]:
    lifecycle = f"{state.diagnostics['state']}, " if "state" in state.diagnostics else ""
    if state.age is None:
        text = "no result yet" if state.is_there else "not there"
        return (_OPEN if state.is_there else _BAD), lifecycle + text
    if state.is_silent:
        return (_OPEN if state.is_there else _BAD), f"{lifecycle}silent for {duration(state.age)}"
    return _GOOD, f"{lifecycle}alive"


def duration(seconds: float) -> str:
    """An age as text: 4 s, 3 min, 2 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"
