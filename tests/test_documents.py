"""The documents as a stranger uses them: the site builds without a warning, its tables are those of the program, and the walks
run as they are written, as pages and as notebooks."""

import html.parser
import os
import pathlib
import re
import subprocess
import sys

import pytest
import tables
import walks

ROOT = pathlib.Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ANOTHER_MACHINE = {"share": 0.25, "least": 0.02}
"""Numbers that a walk prints may differ by this share, and by this much, from those of the page."""
HEAVY = [pytest.param(name, marks=pytest.mark.full) for name in walks.NAMES[1:]]


class _Page(html.parser.HTMLParser):
    """What a page asks for when it is opened, and its text outside of code and headings."""

    ASIDE = ("pre", "code", "script", "style", "h1", "h2", "h3", "h4")

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []
        self.text: list[str] = []
        self._aside = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag in ("script", "img", "iframe", "source"):
            self.asked.append(values.get("src") or "")
        if tag == "link" and values.get("rel") != "canonical":
            self.asked.append(values.get("href") or "")
        self._aside += tag in self.ASIDE

    def handle_endtag(self, tag: str) -> None:
        self._aside -= tag in self.ASIDE

    def handle_data(self, data: str) -> None:
        if not self._aside:
            self.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The site, built as `make docs` does: not with `--quiet`, with which warnings are neither shown nor counted."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_the_site_is_whole_and_asks_nobody(site: pathlib.Path) -> None:
    """Every page is there, nothing is loaded from elsewhere, and no list, table or command is left as plain text."""
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    for path in pages:
        page = _Page()
        page.feed(path.read_text(encoding="utf-8"))
        assert page.asked and not [address for address in page.asked if address.startswith(("http", "//"))], path
        left = re.findall(r"^(?: *[-*] |\d+\. |\|| *omnilines \w+ .*--).*", "".join(page.text), re.M)
        assert left == [], path
    for name in walks.NAMES:
        assert (site / "walks" / f"{name}.ipynb").is_file()
    names = re.findall(r'id="([\w.]+)"', (site / "api" / "index.html").read_text(encoding="utf-8"))
    assert {"omnilines.pipelines.calibrate_one.calibrate", "omnilines.pipelines.scene.Scene"} <= set(names)


@pytest.mark.parametrize("name", tables.TABLES)
def test_tables_are_those_of_the_program(name: str) -> None:
    page = (DOCS / name).read_text(encoding="utf-8")
    assert page == tables.with_tables(name, page), "run: make tables"


@pytest.mark.parametrize("name", walks.NAMES)
def test_notebooks_are_those_of_the_pages(name: str) -> None:
    page, notebook = (walks.PAGES / f"{name}{ending}" for ending in (".md", ".ipynb"))
    assert notebook.read_text(encoding="utf-8") == walks.notebook_of(page.read_text(encoding="utf-8")), "run: make tables"


def test_the_readme_is_one_screen() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 60


@pytest.mark.slow
@pytest.mark.parametrize("name", [walks.NAMES[0], *HEAVY])
def test_a_walk_runs_as_it_is_written(name: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command and every line of Python, in their order; what the page shows is printed."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    compared = 0
    for part in walks.parts_of((walks.PAGES / f"{name}.md").read_text(encoding="utf-8")):
        if isinstance(part, walks.Block):
            printed = walks.run(part, names)
            if part.shown is not None:
                pairs = walks.printed_anew(part.shown, printed)
                assert pairs and walks.numbers_off(pairs, **ANOTHER_MACHINE) == []
                compared += len(pairs)
    assert compared > 8


@pytest.mark.full
@pytest.mark.parametrize("name", walks.NAMES)
def test_a_notebook_runs(name: str, tmp_path: pathlib.Path) -> None:
    """In a process of its own, with the command as it is installed beside this Python; prints what the page shows."""
    import nbformat

    binaries = pathlib.Path(sys.executable).parent
    code = (
        "import nbclient, nbformat\n"
        f"book = nbformat.read({str(walks.PAGES / f'{name}.ipynb')!r}, 4)\n"
        "nbclient.NotebookClient(book, timeout=900, kernel_name='python3').execute()\n"
        "nbformat.write(book, 'done.ipynb')\n"
    )
    path = os.pathsep.join([str(binaries), os.environ["PATH"]])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    cells = [cell for cell in nbformat.read(tmp_path / "done.ipynb", 4).cells if cell.cell_type == "code"]
    page = (walks.PAGES / f"{name}.md").read_text(encoding="utf-8")
    blocks = [part for part in walks.parts_of(page) if isinstance(part, walks.Block)]
    assert len(cells) == len(blocks) >= 3
    for cell, block in zip(cells, blocks, strict=True):
        printed = "".join(output.text for output in cell.outputs if output.get("name") == "stdout")
        if block.shown is not None:
            walks.printed_anew(block.shown, printed)


def test_what_is_not_printed_is_found_out() -> None:
    printed = "Result\n  rms  0.21\n  views  12 of 12\nall of it, and more\n"
    shown = "Result\n...\n  views  12 of 13\nall of it, ...\n"
    pairs = walks.printed_anew(shown, printed)
    assert pairs[2:] == [("  views  12 of 13", "  views  12 of 12"), ("all of it, ...", "all of it, ...")]
    assert walks.numbers_off(pairs, 0.25, 0.02) == [] and walks.numbers_off(pairs, 0.05, 0.02) == pairs[2:3]
    with pytest.raises(ValueError, match="was expected among what is printed"):
        walks.printed_anew("Result\n  mean  0.21\n", printed)
    with pytest.raises(RuntimeError, match="ended with status 2"):
        walks.run(walks.Block("bash", "omnilines convert absent.yaml out.yaml\n", None), {})
    with pytest.raises(ValueError, match="begin with 'omnilines'"):
        walks.commands_of("rm -rf x\n")
