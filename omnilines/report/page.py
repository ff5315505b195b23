"""A report is one HTML file that needs nothing else: a title, sections, and plotly.js inlined once."""

import os
import pathlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import plotly.offline
from markupsafe import Markup, escape

from camera_models.errors import InputError
from camera_models.formats.disk import write_atomically
from omnilines.spelling import spelled

PAGE_LIMIT_BYTES = 15_000_000
"""No report is larger; photos are scaled down or left out to keep below it."""
_RESERVE_BYTES = 300_000

_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("omnilines.report", "templates"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
# A name in backticks, of a parameter or an option, is set as code.
_TEMPLATES.filters["spelled"] = lambda text: Markup(
    re.sub("`([^`<>]+)`", lambda name: f"<code>{spelled(name[1])}</code>", str(escape(text)))
)
# JSON has no NaN: one in a figure must fail here and not in the browser.
_TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


@dataclass(frozen=True)
class Section:
    """One titled part of a report."""

    title: str
    html: Markup | Callable[[int], Markup]
    """The fragment under the heading, or, for a section of photos, a function from the bytes it may take to the fragment."""


def fragment(template: str, **context: Any) -> Markup:
    """The HTML of `templates/<template>.html.j2`; every string in `context` that is not Markup is escaped."""
    return Markup(_TEMPLATES.get_template(f"{template}.html.j2").render(**context))


def write_report(path: str | os.PathLike[str], title: str, sections: Sequence[Section]) -> pathlib.Path:
    """Write the page that holds `sections` in their order, and return its path.

    The page makes no network request and works from a file. It is written beside `path` and moved there, so that no
    half-written report is ever found. Sections of photos share what the others leave of `PAGE_LIMIT_BYTES`.

    Raises InputError where the sections without photos are already larger than that.
    """
    target = pathlib.Path(path)
    plotly_js = plotly.offline.get_plotlyjs()
    fixed = [s.html for s in sections if isinstance(s.html, Markup)]
    elastic = len(sections) - len(fixed)
    left = PAGE_LIMIT_BYTES - _RESERVE_BYTES - sum(len(text.encode()) for text in [plotly_js, *fixed])
    if left < 0:
        raise InputError(
            f"A report holds at most {PAGE_LIMIT_BYTES / 1e6:.0f} MB, and the tables and plots of this one exceed it by "
            f"{-left / 1e6:.1f} MB; write fewer sections or split them over several reports."
        )
    parts = [
        {
            "title": s.title,
            "anchor": _anchor(i, s.title),
            "html": s.html if isinstance(s.html, Markup) else s.html(left // elastic),
        }
        for i, s in enumerate(sections)
    ]
    page = fragment("page", title=title, parts=parts, plotly_js=Markup(plotly_js))

    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, page)
    return target


def _anchor(index: int, title: str) -> str:
    words = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
    return f"s{index + 1}-{words}"
