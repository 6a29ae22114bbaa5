"""What is in the package, wherever it is imported from: the build tree, an install prefix, or what pip built."""

import ast
import json
import re
from importlib import metadata
from pathlib import Path

import gp2
from conftest import ROOT

PACKAGE = Path(gp2.__file__).parent


def without_docstrings(stub):
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Expr(ast.Constant(...))]
    return ast.dump(tree)


def test_every_file_of_the_package_is_there():
    source = ROOT / "python" / "gp2"
    wanted = {path.name for path in source.iterdir() if path.suffix in {".py", ".pyi"} or path.name == "py.typed"}
    assert wanted >= {"__init__.py", "_gp2.pyi", "py.typed", "sklearn.py"}
    assert wanted <= {path.name for path in PACKAGE.iterdir()}
    assert without_docstrings(PACKAGE / "_gp2.pyi") == without_docstrings(source / "_gp2.pyi")
    for name in wanted - {"_gp2.pyi"}:
        assert (PACKAGE / name).read_bytes() == (source / name).read_bytes(), f"{name} is not the checkout's: build again"


def test_the_version_is_the_projects():
    project = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    version = re.search(r"^project\(gp2 VERSION ([\d.]+)", project, re.MULTILINE)[1]
    assert gp2.__version__ == version
    port = json.loads((ROOT / "packaging/vcpkg/gp2/vcpkg.json").read_text(encoding="utf-8"))
    assert port["version"] == version
    consumer = (ROOT / "tests/package/CMakeLists.txt").read_text(encoding="utf-8")
    assert f"find_package(gp2 {version.rsplit('.', 1)[0]} REQUIRED)" in consumer, "its minor version must be asked for"
    for distribution in metadata.distributions(name="gp2"):  # none, but where pip installed it
        assert distribution.version == version
        files = {path.name for path in distribution.files}
        assert files >= {"LICENSE", "THIRD_PARTY.md", "_gp2.pyi", "py.typed"}


def test_every_name_has_a_docstring():
    for name in gp2.__all__:
        if not name.startswith("_"):
            assert getattr(gp2, name).__doc__, name


def test_it_works():
    system = gp2.System(
        coordinates=["x", "y"], mass=[["1", "0"], ["0", "1"]], constraints=["y - x^2"], latents=[{"features": ["x"]}], noise=0.1,
        truth=["-x", "0"], sampling={"x": [-1, 1], "dx": [-1, 1]},
    )  # fmt: skip
    posterior = gp2.fit(system, system.generate(20), restarts=1, max_iterations=20)
    assert posterior.predict([[0.5, 0.25, 0.2, 0.2, 0]]).mean.shape == (1, 2)
