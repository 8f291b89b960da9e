"""Self-contained pages: a template filled in, with styles, scripts and data inside."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from popgen.jsonable import jsonable

_HERE = files("popgen.pages")


@cache
def _open_templates() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("popgen.pages", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def read_asset(name: str) -> str:
    """A style sheet or a script of this package."""
    return (_HERE / "assets" / name).read_text(encoding="utf-8")


def fill_page(template: str, *, title: str, scripts: Sequence[str], data: Mapping[str, Any], **values: Any) -> str:
    """A page as one text.

    Args:
        template: file of `templates/`.
        title: of the page.
        scripts: files of `assets/`, joined to one ES module.
        data: id -> JSON-able value that the scripts read.
        values: of the template.
    """
    from markupsafe import Markup

    return (
        _open_templates()
        .get_template(template)
        .render(
            title=title,
            style=Markup(read_asset("pages.css")),
            script=Markup("\n".join(read_asset(name) for name in scripts)),
            data={name: Markup(embed_json(value)) for name, value in data.items()},
            **values,
        )
    )


def embed_json(value: Any) -> str:
    """JSON that can stand inside a script element: it ends none and begins no comment."""
    text = json.dumps(jsonable(value), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
