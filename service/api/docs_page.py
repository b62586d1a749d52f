"""The page /docs: the OpenAPI document as plain HTML that loads nothing from other hosts."""

from __future__ import annotations

from html import escape

from loopwright.service.api.openapi_document import Document, Operation, Schema

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
code { font: 14px ui-monospace, monospace; }
summary { cursor: pointer; padding: .3rem 0; }
.method { display: inline-block; width: 4rem; font-weight: bold; }
table { border-collapse: collapse; margin: .3rem 0 1rem 4rem; }
td, th { text-align: left; vertical-align: top; padding: .1rem .8rem .1rem 0; }
"""
POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"


def page(document: Document) -> str:
    """The HTML page of an OpenAPI document: the summary, parameters, body and responses of every operation."""
    info = document["info"]
    schemas = document["components"].get("schemas", {})
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(info['title'])}</title>",
        f"<style>{STYLE}</style><h1>{escape(info['title'])} {escape(info['version'])}</h1>",
        f"<p>{escape(info.get('description', ''))}</p>",
        "<p>For programs: <a href=openapi.json>openapi.json</a></p>",
    ]
    tag = None
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if operation.get("tags", [""])[0] != tag:
                tag = operation.get("tags", [""])[0]
                parts.append(f"<h2>{escape(tag or 'more')}</h2>")
            parts.append(_operation(path, method, operation, schemas))
    return "\n".join(parts) + "\n</html>\n"


def _operation(path: str, method: str, operation: Operation, schemas: dict[str, Schema]) -> str:
    rows = [
        (f"{x['name']} ({x['in']})", x.get("description", ""), x.get("required", False))
        for x in operation.get("parameters", ())
    ]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
    rows += _body(_names(body), schemas)
    rows += [(str(k), v.get("description", ""), False) for k, v in operation.get("responses", {}).items()]
    cells = "".join(
        f"<tr><td><code>{escape(name)}</code>{' *' if required else ''}<td>{escape(text)}"
        for name, text, required in rows
    )
    return (
        f"<details><summary><span class=method>{method.upper()}</span><code>{escape(path)}</code> "
        f"{escape(operation.get('summary', ''))}</summary>"
        f"<p>{escape(operation.get('description', ''))}</p><table>{cells}</table></details>"
    )


def _body(names: list[str], schemas: dict[str, Schema]) -> list[tuple[str, str, bool]]:
    """The fields of a body with any of these schemas: name, description, whether the field is required. A field that
    only some of the schemas have is followed by their names."""
    having: dict[str, list[str]] = {}
    for name in names:
        for field in schemas[name].get("properties", {}):
            having.setdefault(field, []).append(name)
    rows = []
    for field, those in having.items():
        where = "body" if those == names else "body: " + ", ".join(those)
        text = schemas[those[0]]["properties"][field].get("description", "")
        rows.append((f"{field} ({where})", text, all(field in schemas[name].get("required", ()) for name in those)))
    return rows


def _names(schema: Schema) -> list[str]:
    """The names of the component schemas that a schema refers to, directly or in a union."""
    choices = (schema, *schema.get("anyOf", ()), *schema.get("oneOf", ()))
    direct = [str(choice["$ref"]).rpartition("/")[2] for choice in choices if "$ref" in choice]
    return direct + [name for choice in choices[1:] if "$ref" not in choice for name in _names(choice)]
