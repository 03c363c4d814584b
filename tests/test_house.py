"""How the house is kept: what the plan promises about modules, and that the README's commands exist."""

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = ("evstim", "emulator", "transports", "firmware_protocol", "laboratory")
MODULES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
LONGEST = 600


def test_every_module_is_short_and_says_what_it_is():
    assert {str(path.relative_to(ROOT)): why for path in MODULES if (why := offence(path))} == {}


def offence(path):
    """Return what a module lacks, or the empty string."""
    text = path.read_text()
    if text.count("\n") > LONGEST:
        return f"more than {LONGEST} lines"
    return "" if ast.get_docstring(ast.parse(text)) else "no docstring"


def test_no_module_has_a_name_that_says_nothing():
    assert not {path.stem for path in MODULES} & {"utils", "util", "common", "core", "manager", "helpers", "misc"}


def test_every_dependency_has_a_reason():
    text = (ROOT / "pyproject.toml").read_text()
    declared = tomllib.loads(text)["project"]["dependencies"]
    for requirement in declared:
        assert re.search(rf'"{re.escape(requirement)}",\s+# .+', text), requirement


def test_links_in_the_docs_lead_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_nothing_installs_evstim_from_a_package_index():
    """The name on the index is not ours."""
    told = [*ROOT.glob("*.md"), *ROOT.glob("rigs/*.toml"), *ROOT.glob("docs/**/*.md"), *MODULES]
    told += [path for ending in ("md", "py", "toml", "ipynb") for path in (ROOT / "examples").rglob(f"*.{ending}")]
    wrong = re.compile(r"pip install '?evstim\b|evstim\[\w")
    assert [path.name for path in told if path.name != "CHANGELOG.md" and wrong.search(path.read_text())] == []
