"""/docs as a plain page made from the OpenAPI document: no script, and no request to any other host."""

from __future__ import annotations

import json
from html import escape
from typing import Any

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
h2 { margin: 2.5rem 0 .3rem; font-size: 1.05rem }
h2 b { color: #06c; display: inline-block; min-width: 4.5rem }
code, pre { font: 14px/1.45 ui-monospace, monospace }
pre { background: #f4f4f6; padding: .7rem; overflow: auto }
table { border-collapse: collapse; margin: .4rem 0 } td { padding: .1rem .9rem .1rem 0; vertical-align: top }
@media (prefers-color-scheme: dark) { body { background: #16161a; color: #ddd } pre { background: #222228 } }
"""


def docs_page(document: dict[str, Any]) -> str:
    """HTML that lists every operation of an OpenAPI document: parameters, bodies with examples, answers."""
    info = document["info"]
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        f"<title>{escape(info['title'])}</title><style>{_STYLE}</style>",
        f"<h1>{escape(info['title'])} <small>{escape(info['version'])}</small></h1>",
        f"<p>{escape(info.get('description', ''))}</p>",
        "<p>For machines: <a href=/openapi.json>/openapi.json</a>.</p>",
    ]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            parts += _operation(path, method, operation)
    return "\n".join(parts)


def _operation(path: str, method: str, operation: dict[str, Any]) -> list[str]:
    parts = [
        f"<h2><b>{escape(method.upper())}</b> <code>{escape(path)}</code></h2>",
        f"<p>{escape(operation.get('summary', ''))}. {escape(operation.get('description', ''))}</p>",
    ]
    rows = [
        (f"{one['name']} ({one['in']})", one.get("description", ""))
        for one in operation.get("parameters", [])
        if one["in"] != "path"
    ]
    content = operation.get("requestBody", {}).get("content", {})
    if content:
        rows.append(("body", " or ".join(content)))
    rows += [(status, answer["description"]) for status, answer in sorted(operation["responses"].items())]
    parts += ["<table>", *(f"<tr><td><code>{escape(a)}</code><td>{escape(b)}" for a, b in rows), "</table>"]
    for media in content.values():
        examples = media.get("examples", {"": {"value": media["example"]}} if "example" in media else {})
        for example in examples.values():
            summary = f"<p>{escape(example['summary'])}:</p>" if "summary" in example else ""
            parts.append(f"{summary}<pre>{escape(json.dumps(example['value'], indent=1))}</pre>")
    return parts
