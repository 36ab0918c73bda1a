"""Pages for the folders of the site that a page links to: the names in each, as a file server would list them."""

from html import escape
from pathlib import Path


def on_post_build(config: dict[str, str]) -> None:
    """Called by mkdocs when the site is written."""
    site = Path(config["site_dir"])
    for folder in sorted(path for path in site.rglob("*") if path.is_dir() and not (path / "index.html").exists()):
        rows = [
            f'<li><a href="{escape(one.name)}{"/index.html" if one.is_dir() else ""}">{escape(one.name)}</a></li>'
            for one in sorted(folder.iterdir())
        ]
        title = escape(str(folder.relative_to(site)))
        head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><h1>{title}</h1>'
        (folder / "index.html").write_text(f"{head}<ul>{''.join(rows)}</ul></html>\n", encoding="utf-8")
