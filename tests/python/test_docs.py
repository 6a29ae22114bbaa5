"""The blocks ```python test of a page run one after another in one fresh folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gp2

ROOT = Path(__file__).resolve().parents[2]


def script_of(page):
    """The blocks of a page, each on the line where it stands there."""
    lines, inside = [], False
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("```"):
            inside = line.rstrip() == "```python test"
            lines.append("")
        else:
            lines.append(line if inside else "")
    return "\n".join(lines) + "\n"


PAGES = [page for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))] if script_of(page).strip()]


def test_the_guide_has_blocks():
    assert ROOT / "docs" / "python.md" in PAGES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_blocks_run(page, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    script = tmp_path / f"{page.stem}.py"
    script.write_text(script_of(page), encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(Path(gp2.__file__).resolve().parents[1])}
    # a motion may leave the data, which is said
    warnings = ["-W", "error", "-W", "ignore:the motion leaves the region of the data"]
    result = subprocess.run(
        [sys.executable, *warnings, script], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
