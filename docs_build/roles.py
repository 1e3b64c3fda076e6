"""An extension of griffe, which reads the docstrings for docs/api.md: roles of reStructuredText become plain code."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:mod|func|class|meth|attr|data):`(?:[^`<]*<)?~?([^`>]+)>?`")


class Roles(griffe.Extension):
    """``:func:`canonical_view.from_mask``` is shown as ```canonical_view.from_mask```."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(r"`\1`", obj.docstring.value)
