"""README.md and docs/: links, paths, the length of sentences, and agreement with the program."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from droid_jax.cost.noise import NoiseConfig
from droid_jax.discrepancy.config import BlocksConfig, DiscrepancyConfig, SelectionConfig
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.simulate.windows import WindowConfig

ROOT = Path(__file__).resolve().parents[1]
WRITTEN = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "experiments/README.md", "benchmarks/README.md")
DOCUMENTS = [ROOT / name for name in WRITTEN] + sorted((ROOT / "docs").rglob("*.md"))
CODE = ("droid_jax", "tests", "experiments", "benchmarks", "docs")

spec = importlib.util.spec_from_file_location("sentences", ROOT / "docs" / "sentences.py")
assert spec is not None and spec.loader is not None
prose = importlib.util.module_from_spec(spec)
spec.loader.exec_module(prose)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(path: Path) -> set[str]:
    """Names of a document's headings, as links call them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}


def faults(path: Path, text: str) -> list[str]:
    """Relative links of a document that lead nowhere: no such file, or no such heading."""
    out = []
    for to, _, anchor in (link.partition("#") for link in re.findall(r"\]\(([^()\s]+)\)", text)):
        target = path.parent / to if to else path
        if "://" in to:
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            out.append(f"{to}#{anchor}".removesuffix("#"))
    return out


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_links_lead_to_a_file_and_a_heading(document: Path):
    assert faults(document, document.read_text()) == []


def test_a_link_that_leads_nowhere_is_seen():
    text = "[a](nowhere.md), [b](docs/README.md#nowhere), [c](#droid_jax), [d](docs/method.md#words)"
    assert faults(ROOT / "README.md", text) == ["nowhere.md", "docs/README.md#nowhere"]
    assert sum(len(re.findall(r"\]\(", d.read_text())) for d in DOCUMENTS) > 200


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_no_document_holds_what_a_program_said_beside_its_answer(document: Path):
    """Regression: two lines about warp stood between a heading and its table and broke the table."""
    assert "Failed to import" not in document.read_text()


def test_the_documents_name_only_files_that_exist():
    """Paths of this repository in backticks."""
    text = "".join((ROOT / d).read_text() for d in ("README.md", "docs/paper.md", "docs/your-robot.md"))
    named = set(re.findall(r"`((?:experiments|benchmarks|mjcf|tests|docs)/[\w./]+\.\w+)`", text))
    assert named and [n for n in sorted(named) if not (ROOT / n).exists()] == []


def test_the_code_names_only_documents_that_exist():
    """Docstrings, messages and comments."""
    files = [p for folder in CODE for p in (ROOT / folder).rglob("*.py")]
    named = {n for p in files for n in re.findall(r"\bdocs/[\w/-]+\.md", p.read_text())}
    assert len(named) > 8 and [n for n in sorted(named) if not (ROOT / n).is_file()] == []


def test_a_sentence_has_fewer_than_twenty_words_on_average():
    counts = prose.counts()
    assert {"README.md", "docs/method.md", "docs/tutorial/README.md"} <= set(counts)
    assert not any(n.startswith("docs/history/") for n in counts)
    assert prose.mean([n for lengths in counts.values() for n in lengths]) < 20
    assert {n: prose.mean(lengths) for n, lengths in counts.items() if prose.mean(lengths) >= 20} == {}


def test_what_counts_as_a_sentence():
    text = """# A heading that is none.

One two three. Four `five six` [seven
eight](nine.md)!

| a | table. Row. |

- A list item, ch. 7 of it
- Another one: here.

```
not. counted.
```
"""
    assert prose.sentences(text) == [
        "One two three.", "Four `five six` seven eight!", "A list item, ch. 7 of it", "Another one: here."
    ]  # fmt: skip
    assert [prose.words(s) for s in prose.sentences(text)] == [3, 5, 7, 3]


def test_the_script_ends_with_one_line_of_json(tmp_path: Path):
    command = [sys.executable, str(ROOT / "docs" / "sentences.py"), "--out", str(tmp_path)]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    last = json.loads(out.splitlines()[-1])
    assert last["mean"] == round(prose.mean([n for c in prose.counts().values() for n in c]), 2)
    assert json.loads((tmp_path / "sentences.json").read_text())["by_file"] == last["by_file"]


def test_the_readme_is_short():
    """At most 500 words beside its two commands, one picture, one table."""
    text = (ROOT / "README.md").read_text()
    commands = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert [c.split(" && ")[-1].strip() for c in commands] == ["python -m droid_jax.run", "python -m pytest"]
    assert len(text.split()) - sum(len(c.split()) for c in commands) <= 500
    assert text.count("![") == 1 and len(re.findall(r"^\|[-|]+\|$", text, re.MULTILINE)) == 1


def test_the_tree_of_the_architecture_is_the_packages():
    text = (ROOT / "docs" / "architecture.md").read_text()
    tree = text.split("```")[1]
    files = {p.name for p in (ROOT / "droid_jax").rglob("*.py")} - {"__init__.py"}
    assert sorted(files - set(re.findall(r"[\w]+\.py", tree))) == []


def documented() -> dict[tuple[str, str], str]:
    """(config, field) -> value of docs/discrepancy-search.md's table of thresholds."""
    text = (ROOT / "docs" / "discrepancy-search.md").read_text()
    config, out = "", dict[tuple[str, str], str]()
    for first, value in re.findall(r"^\| ([^|]+) \| ([^|]*)\|", text[text.index("## Thresholds") :], re.MULTILINE):
        if first.startswith("**"):
            config = first.strip("*`")
        elif re.fullmatch(r"`\w+`", first):
            out[config, first.strip("`")] = value.strip()
    return out


@pytest.mark.parametrize("config", [SelectionConfig, BlocksConfig], ids=lambda config: config.__name__)
def test_every_threshold_is_documented(config: type):
    fields = {f.name: f.default for f in dataclasses.fields(config)}
    rows = {name: value for (of, name), value in documented().items() if of == config.__name__}
    assert {name: float(value) for name, value in rows.items()} == pytest.approx(fields, rel=1e-3)


@pytest.mark.parametrize(
    "config",
    [NoiseConfig, DiscrepancyConfig, RefineConfig, CmaConfig, WindowConfig],
    ids=lambda config: config.__name__,
)
def test_documented_settings_are_the_defaults(config: type):
    rows = {name: value for (of, name), value in documented().items() if of == config.__name__}
    numbers = {name: float(value) for name, value in rows.items() if re.fullmatch(r"[\d.e-]+", value)}
    assert len(numbers) > 3
    assert numbers == pytest.approx({name: getattr(config(), name) for name in numbers})
    lists = {name: value.split(", ") for name, value in rows.items() if re.fullmatch(r"[\d.]+(, [\d.]+)+", value)}
    assert {name: tuple(map(float, value)) for name, value in lists.items()} == {n: getattr(config(), n) for n in lists}
