"""The types that editors and mypy read are those of the module."""

import ast
import functools
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gp2
from gp2 import _gp2, _model_text

PACKAGE = Path(gp2.__file__).parent
STUB = ast.parse((PACKAGE / "_gp2.pyi").read_text(encoding="utf-8"))


def mypy(*arguments):
    outcome = subprocess.run(
        [sys.executable, "-m", *arguments], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=300
    )
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr


def test_mypy_is_content_with_stub_package_and_a_users_code(tmp_path):
    for file in ("_gp2.pyi", "_model_text.py", "__init__.py", "py.typed"):
        assert (PACKAGE / file).exists()
    strict = ["mypy", "--strict", "--warn-unused-ignores", f"--cache-dir={tmp_path}"]
    mypy(*strict, "-m", "gp2", "-m", "gp2._gp2", "-m", "gp2._model_text", "-m", "gp2._objects", "-m", "gp2._plots")
    mypy(*strict, str(Path(__file__).with_name("typed_usage.py")))
    mypy(*strict, "--ignore-missing-imports", "-m", "gp2.sklearn")
    mypy(*strict, "--ignore-missing-imports", str(Path(__file__).with_name("typed_regressor.py")))


def test_stubtest_finds_no_difference(tmp_path):
    allowed = tmp_path / "allowed"
    # of a class itself its metaclass, which is pybind11's, the __init__ of those that are not to be made, and what the module
    # copy asks for
    allowed.write_text(r"gp2\._gp2\.[A-Z]\w*(\.__(init|copy|deepcopy)__)?", encoding="utf-8")
    mypy("mypy.stubtest", "gp2._gp2", "--allowlist", str(allowed), "--ignore-unused-allowlist")


def public(members):
    return {name for name in members if not name.startswith("_")}


def test_every_public_name_is_in_the_stub():
    classes = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")}
    functions = {node.name for node in STUB.body if isinstance(node, ast.FunctionDef)}
    constants = {node.target.id for node in STUB.body if isinstance(node, ast.AnnAssign)}
    assert set(classes) | functions | constants == public(vars(_gp2)) | {"__version__"}
    assert set(classes) | functions <= set(gp2.__all__)
    for name, node in classes.items():
        inherited = public(dir(getattr(_gp2, name).__base__))
        members = {member.name for member in node.body if isinstance(member, ast.FunctionDef)}
        assert public(members) == public(dir(getattr(_gp2, name))) - inherited, name


def test_editors_read_in_the_stub_what_help_tells():
    told = {}
    for node in ast.walk(STUB):
        if isinstance(node, ast.ClassDef):
            told[node.name] = ast.get_docstring(node)
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    told.setdefault(f"{node.name}.{member.name}", ast.get_docstring(member))
    told |= {node.name: ast.get_docstring(node) for node in reversed(STUB.body) if isinstance(node, ast.FunctionDef)}
    named = [name for name in told if not re.search(r"(^|\.)_", name)]
    assert not [name for name in named if not told[name]]
    for name in named:
        lines = [line.strip() for line in told[name].splitlines()]
        help_of = functools.reduce(getattr, name.split("."), _gp2).__doc__
        assert all(line in help_of for line in lines), name
        assert not lines[0].startswith(f"{name.split('.')[-1]}("), name


# ---------------------------------------------------------------- parameters


def of_stub(node):
    """[(name, kind, default)] of a function in the stub."""
    arguments = node.args
    positional = arguments.posonlyargs + arguments.args
    defaults = [None] * (len(positional) - len(arguments.defaults)) + arguments.defaults
    named = [(a.arg, "positional", d) for a, d in zip(positional, defaults)]
    named += [(a.arg, "keyword", d) for a, d in zip(arguments.kwonlyargs, arguments.kw_defaults)]
    return [(name, kind, None if d is None else ast.unparse(d)) for name, kind, d in named if name != "self"]


def of_docstring(text):
    """The same of the first line that pybind11 writes: name(self: X, states: object, view: str = 'constrained', *, …) -> Y"""
    text = re.sub(r"\*\*kwargs", "", text.splitlines()[0])
    node = ast.parse(f"def {text}: ...").body[0]
    return of_stub(node)


def functions_of_stub():
    for node in STUB.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node, getattr(_gp2, node.name)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for member in node.body:
                is_property = any(getattr(d, "id", "") == "property" for d in getattr(member, "decorator_list", []))
                if isinstance(member, ast.FunctionDef) and not is_property:
                    yield f"{node.name}.{member.name}", member, getattr(getattr(_gp2, node.name), member.name)


def same(ours, theirs):
    if ours is None or theirs is None:
        return ours == theirs
    return ast.literal_eval(ours) == ast.literal_eval(theirs)


@pytest.mark.parametrize(("name", "node", "function"), [pytest.param(*f, id=f[0]) for f in functions_of_stub()])
def test_parameters_of_the_stub_are_those_of_the_module(name, node, function):
    stub = of_stub(node)
    if name == "System.__init__":
        real = inspect.signature(_model_text.model_text).parameters.values()
        assert [(n, kind) for n, kind, _ in stub] == [(p.name, "keyword") for p in real]
        for (_, _, ours), theirs in zip(stub, real):
            assert (theirs.default is theirs.empty) if ours is None else (ast.literal_eval(ours) == theirs.default)
        return
    module = of_docstring(function.__doc__)
    assert [parameter[:2] for parameter in stub] == [parameter[:2] for parameter in module]
    overloaded = any(getattr(d, "id", "") == "overload" for d in node.decorator_list)
    for (parameter, _, ours), (_, _, theirs) in zip(stub, module):
        if not (overloaded and parameter == "n_samples"):
            assert same(ours, theirs), parameter
