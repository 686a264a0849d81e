"""The JSON Schema of a scenario, with which editors complete and check a TOML file.

A file names it in its first line, `#:schema PATH`, as the TOML extensions of editors read it.
"""

import json
from typing import Any

from estbench.scenario.schema import Scenario

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def json_schema() -> str:
    """The schema as JSON text; pydantic makes it of `Scenario`.

    Only `name` and `model.path` are required, as in a file.
    """
    schema = {"$schema": DIALECT, **Scenario.model_json_schema()}
    return json.dumps(_plain(schema), indent=1, ensure_ascii=False) + "\n"


def _plain(node: Any) -> Any:
    """Without the titles that pydantic derives from the keys, and without null: TOML has none."""
    if isinstance(node, list):
        return [_plain(item) for item in node]
    if not isinstance(node, dict):
        return node
    out = {k: _plain(v) for k, v in node.items() if not (k == "title" and isinstance(v, str))}
    options = [o for o in out.get("anyOf", []) if o != {"type": "null"}]
    if "anyOf" in out:
        del out["anyOf"]
        out = {**out, "anyOf": options} if len(options) > 1 else {**options[0], **out}
    if out.get("default", "") is None:
        del out["default"]
    return out
