"""What the site does with the documents that lie beside `docs/`: they are pages too, and links between both go where they should.

MkDocs calls these functions (`hooks` in mkdocs.yml). Links stay as they are read on a Git host: `../CONTRIBUTING.md` from a page,
`docs/formats.md` from a document of the root.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "THIRD_PARTY.md": "third_party.md",
}
"""Document of the root -> its page."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the documents of the root as pages."""
    for name, page in DOCUMENTS.items():
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=_between_pages(text, "")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to documents of the root to their pages."""
    return _between_pages(markdown, "../" * page.file.src_uri.count("/"))


def _between_pages(markdown: str, up: str) -> str:
    """A text whose links to documents of the root lead to their pages, `up` from it."""
    names = "|".join(map(re.escape, DOCUMENTS))
    return re.sub(rf"\]\((?:\.\./)*({names})", lambda link: f"]({up}{DOCUMENTS[link[1]]}", markdown)
