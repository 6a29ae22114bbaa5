"""Writes the stub of the module with the module's own docstrings, for editors that read no compiled module:
python describe_stub.py FOLDER_OF_THE_PACKAGE STUB OUTPUT"""

import ast
import inspect
import re
import sys
from pathlib import Path


def text_of(member, name):
    """The docstring without the signatures before it, which are those of the stub."""
    text = inspect.cleandoc(getattr(member, "__doc__", None) or "")
    if inspect.isroutine(member):
        text = re.sub(r"\A\w+\(\*args, \*\*kwargs\)\nOverloaded function\.\n+", "", text)
        text = re.sub(rf"^(\d+\. )?{name}\(.*\)( -> .*)?$\n*", "", text, flags=re.MULTILINE)
    return text.strip()


def described(stub, module):
    lines = stub.splitlines(keepends=True)
    insertions = []  # (node, text)
    seen = set()  # the first of overloads has the text of all

    def visit(node, owner):
        member = getattr(owner, node.name, None)
        if member is None or (id(owner), node.name) in seen:
            return
        seen.add((id(owner), node.name))
        if text := text_of(member, node.name):
            insertions.append((node, text))
        if isinstance(node, ast.ClassDef):
            visit_all(node.body, member)

    def visit_all(nodes, owner):
        for node in nodes:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_"):
                visit(node, owner)

    visit_all(ast.parse(stub).body, module)
    for node, text in reversed(insertions):
        indent = " " * (node.col_offset + 4)
        quoted = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
        if quoted.endswith('"'):
            quoted = quoted[:-1] + '\\"'
        docstring = [f"{indent}{line}".rstrip() + "\n" for line in f'"""{quoted}"""'.splitlines()]
        first = node.body[0]
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and first.value.value is ...:
            line = lines[first.lineno - 1]
            lines[first.lineno - 1 : first.lineno] = [line[: first.col_offset].rstrip() + "\n", *docstring]
        else:
            decorators = getattr(first, "decorator_list", [])
            at = min([first.lineno, *(one.lineno for one in decorators)]) - 1
            lines[at:at] = [*docstring, "\n"]
    return "".join(lines)


if __name__ == "__main__":
    package, stub, output = map(Path, sys.argv[1:])
    sys.path.insert(0, str(package.parent))
    written = stub.read_text(encoding="utf-8")
    try:
        from gp2 import _gp2
    except ImportError as error:  # of another machine or Python than this one
        print(f"the stub has no docstrings: {error}")
    else:
        written = described(written, _gp2)
    output.write_text(written, encoding="utf-8")
