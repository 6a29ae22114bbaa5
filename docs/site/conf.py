"""The site of the documentation, by Sphinx. scripts/site puts this into a copy of the pages and runs it."""

import os
import re
from pathlib import Path

import furo
import gp2

ROOT = Path(__file__).parent

project = "gp2"
version = release = gp2.__version__
author = "the authors of gp2"
copyright = author
language = "en"

extensions = ["myst_parser", "breathe", "sphinx.ext.autodoc"]
root_doc = "index"
html_theme = "furo"
html_title = f"gp2 {version}"
html_copy_source = False
html_show_sourcelink = False
pygments_dark_style = "monokai"
# Debian's furo has the colours of its dark theme, but not for a system that asks for one
css = (Path(furo.__file__).parent / "theme/furo/static/styles/furo.css").read_text("utf-8")
dark = re.search(r"""body\[data-theme="?dark"?\]\s*\{(.*?)\}""", css, re.S)[1]
html_theme_options = {"dark_css_variables": {name: value.strip() for name, value in re.findall(r"--([\w-]+):([^;]+);", dark)}}

# pages link to headings as a Git forge names them
myst_heading_anchors = 4

breathe_projects = {"gp2": os.environ["GP2_DOXYGEN_XML"]}
breathe_default_project = "gp2"
breathe_default_members = ("members",)

autodoc_member_order = "groupwise"
autodoc_default_options = {"members": True, "undoc-members": True}


def escaped(text):
    return re.sub(r"([\\*_`|])", r"\\\1", text)


def as_restructured_text(app, what, name, obj, options, lines):
    """Docstrings are plain text: paragraphs, and lines of a name and, behind spaces, what it is."""
    out, in_list = [], False
    for line in lines:
        entry = re.match(r"(\S+(?:, \S+)*) {2,}(\S.*)$", line)
        if entry:
            if not in_list:
                out.append("")
            out += [f"``{entry[1]}``", f"    {escaped(entry[2])}"]
        elif in_list and line.strip():  # goes on
            out.append(f"    {escaped(line.strip())}")
        else:
            out += ["", escaped(line.strip())] if in_list else [escaped(line.strip())]
        in_list = bool(entry) or (in_list and bool(line.strip()))
    lines[:] = [*out, ""]


def public_names(app, what, name, obj, options, signature, returned):
    """gp2.System, which lies in gp2._gp2."""

    def named(text):
        return text and re.sub(r"\bgp2\._gp2\.|\bnumpy\.|\b_gp2\.", lambda found: "gp2." if "gp2" in found[0] else "", text)

    return named(signature), named(returned)


def without_folders(app, page, source):
    """A link to a folder has nowhere to go on a site: its text stays."""
    here = (ROOT / page).parent

    def text_or_link(link):
        return link[1] if (here / link[2]).is_dir() else link[0]

    source[0] = re.sub(r"\[([^\]]+)\]\(([^)#:]+)\)", text_or_link, source[0])


def python_reference(app, page, source):
    """A directive for each public name, functions first."""
    if page != "api/python":
        return
    kinds = {"Functions": [], "Classes": [], "Errors": []}
    for name in gp2.__all__:
        thing = getattr(gp2, name)
        if not isinstance(thing, type):
            if callable(thing):
                kinds["Functions"].append(f".. autofunction:: gp2.{name}")
        elif issubclass(thing, Exception):
            kinds["Errors"].append(f".. autoexception:: gp2.{name}\n   :no-members:")
        else:
            kinds["Classes"].append(f".. autoclass:: gp2.{name}")
    kinds["scikit-learn"] = [".. autoclass:: gp2.sklearn.GP2Regressor"]
    for kind, directives in kinds.items():
        source[0] += f"\n## {kind}\n\n```{{eval-rst}}\n" + "\n\n".join(directives) + "\n```\n"


def setup(app):
    app.connect("source-read", without_folders)
    app.connect("source-read", python_reference)
    app.connect("autodoc-process-docstring", as_restructured_text)
    app.connect("autodoc-process-signature", public_names)
