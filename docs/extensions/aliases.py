"""References by any name under which an object can be imported, or by the one that it has in its own module."""

from __future__ import annotations

import importlib
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

_PACKAGE = "torchrl_tsallis"


def _found(name: str) -> Any:
    """The object with a dotted name, or None."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:end]))
        except ImportError:
            continue
        for part in parts[end:]:
            found = getattr(found, part, None)
        return found
    return None


def _resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> nodes.Element | None:
    if node.get("refdomain") != "py":
        return None
    target, module = node["reftarget"], node.get("py:module")
    within = [f"{module}.{node.get('py:class')}", module] if module else []
    names = [name for name in [target, *(f"{scope}.{target}" for scope in within)] if name.startswith(_PACKAGE)]
    domain = env.get_domain("py")
    for wanted in filter(lambda found: found is not None, map(_found, names)):
        for name, entry in domain.objects.items():
            if name.endswith(f".{target.rpartition('.')[2]}") and _found(name) is wanted:
                reference = nodes.reference("", "", content, internal=True, reftitle=name)
                reference["refuri"] = app.builder.get_relative_uri(node["refdoc"], entry.docname) + "#" + entry.node_id
                return reference
    return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Resolves what Sphinx does not."""
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
