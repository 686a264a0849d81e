"""What mkdocs does not do by itself: pages and files from outside of docs/, and equations.

`results/*.md` and `CHANGELOG.md` become pages, files that a page links to in `examples/` and
`assets/` are copied to `source/`, and LaTeX becomes MathML, which browsers draw without a script.
"""

import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]
from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parents[1]
PAGES = {
    "results/leaderboard.md": "leaderboard.md",
    "results/entries.md": "entries.md",
    "results/estimators.md": "results-estimators.md",
    "CHANGELOG.md": "changelog.md",
    "README.md": "index.md",
}
"""File of the repository -> page of the site; README's place is that of the first page."""
TABLES = {"leaderboard.md", "entries.md", "results-estimators.md"}
"""Pages of wide tables, which have the column of the table of contents too."""
_OUTSIDE = re.compile(r"\]\((?:\.\./)+(?P<path>[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_MATH = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<tex>.*?)\\[)\]]</(?P=tag)>', re.S
)


def on_files(files, config):
    """Add the generated pages, and the files that pages link to."""
    for source, page in PAGES.items():
        if source != "README.md":
            text = (ROOT / source).read_text(encoding="utf-8")
            files.append(File.generated(config, page, content=text))
    linked = set()
    for file in list(files.documentation_pages()):
        linked |= {m["path"] for m in _OUTSIDE.finditer(file.content_string)}
    for path in sorted(linked - PAGES.keys()):
        if not path.startswith("docs/") and (ROOT / path).is_file():
            text = (ROOT / path).read_text(encoding="utf-8")
            files.append(File.generated(config, f"source/{path}", content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links to files of the repository into links to pages or to copies."""
    if page.file.src_uri in TABLES:
        page.meta.setdefault("hide", ["toc"])
    return _OUTSIDE.sub(_inside, markdown)


def on_page_content(html, page, config, files):
    """Turn the LaTeX that arithmatex marks into MathML."""

    def drawn(match):
        display = "block" if match["open"] == "[" else "inline"
        return convert(unescape(match["tex"]).strip(), display=display)

    return _MATH.sub(drawn, html)


def _inside(match):
    path, anchor = match["path"], match["anchor"] or ""
    if path.startswith("docs/"):
        return f"]({path.removeprefix('docs/')}{anchor})"
    if path in PAGES:
        return f"]({PAGES[path]}{anchor})"
    return f"](source/{path})"
