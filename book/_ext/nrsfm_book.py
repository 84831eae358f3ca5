"""The book's Sphinx extension: plotly figures and mathematics that need no other host.

`PlotlyRenderer` is found by MyST-NB through its entry point (pyproject.toml beside this file) and
turns the one thing that plotly emits inside a kernel into a figure that `_static/figures.js` draws.
"""

import importlib.util
import json
import shutil
from html import escape
from pathlib import Path

import plotly
from docutils import nodes

MIME = "application/vnd.plotly.v1+json"


class PlotlyRenderer:
    """Writes a plotly figure into the page as JSON, beside one shared plotly.min.js."""

    mime_priority_overrides = (("html", MIME, 5), ("dirhtml", MIME, 5))

    @staticmethod
    def handle_mime(renderer, data, inline):
        if data.mime_type != MIME:
            return None
        renderer.add_js_file("plotly", "plotly.min.js", {"defer": "defer"})
        renderer.add_js_file("figures", "figures.js", {"defer": "defer"})
        figure = data.content
        height = figure.get("layout", {}).get("height", 450)
        alt = data.cell_metadata.get("mystnb", {}).get("image", {}).get("alt", "interactive figure")
        body = json.dumps(figure, separators=(",", ":")).replace("</", "<\\/")
        html = (
            f'<div class="plotly-figure" role="img" aria-label="{escape(alt)}" style="height:{height}px">'
            f'<script type="{MIME}">{body}</script></div>'
        )
        return [nodes.raw(text=html, format="html")]


def copy_assets(app):
    """plotly.js and MathJax, from the installed packages into _static."""
    if app.builder.format != "html":
        return
    out = Path(app.outdir, "_static")
    fonts = "output/chtml/fonts/woff-v2"
    source = Path(importlib.util.find_spec("sphinx-mathjax-offline").origin).parent / "static/mathjax"
    (out / "mathjax" / fonts).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(Path(plotly.__file__).parent / "package_data/plotly.min.js", out / "plotly.min.js")
    shutil.copyfile(source / "tex-chtml-full.js", out / "mathjax/tex-chtml-full.js")
    shutil.copytree(source / fonts, out / "mathjax" / fonts, dirs_exist_ok=True)


def prune_scripts(app, pagename, templatename, context, doctree):
    """Leave out what the theme declares twice, and sphinx-thebe, whose constant points to another host."""
    seen, kept = set(), []
    for script in context.get("script_files", []):
        body = (getattr(script, "attributes", None) or {}).get("body") or ""
        if "THEBE_JS_URL" in body or "sphinx-thebe" in str(getattr(script, "filename", script)):
            continue
        if body and body in seen:
            continue
        seen.add(body)
        kept.append(script)
    context["script_files"] = kept


def setup(app):
    app.config.mathjax_path = "mathjax/tex-chtml-full.js"
    app.connect("builder-inited", copy_assets)
    app.connect("html-page-context", prune_scripts, priority=990)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
