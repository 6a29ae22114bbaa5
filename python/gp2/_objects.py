"""What Python expects of objects, and C++ does not give: copies, pickles, and a __repr__ that pprint takes."""

from __future__ import annotations

import copyreg
import tempfile
from pathlib import Path
from typing import Any

from gp2 import _gp2


def _read_system(text: str, name: str, robot: str | None = None) -> _gp2.System:
    return _gp2.System.parse(text, name, robot)


# a system travels as text
def _reduce_system(system: _gp2.System) -> tuple[Any, ...]:
    try:
        _read_system(system.text, system.name, system.robot)
    except _gp2.InputError as error:  # it has functions
        raise TypeError(f"'{system.name}' cannot be pickled: it has functions, which are code") from error
    return _read_system, (system.text, system.name, system.robot)


def _read_posterior(content: bytes) -> _gp2.Posterior:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fit.json")
        path.write_bytes(content)
        return _gp2.load(path)


# a posterior travels as the content of its file
def _reduce_posterior(posterior: _gp2.Posterior) -> tuple[Any, ...]:
    _reduce_system(posterior.system)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fit.json")
        posterior.save(path)
        return _read_posterior, (path.read_bytes(),)


def _with_hash(described: Any) -> Any:
    return lambda self: described(self)


def _prepare() -> None:
    # a system never changes: it is its own copy
    setattr(_gp2.System, "__copy__", lambda self: self)
    setattr(_gp2.System, "__deepcopy__", lambda self, memo: self)
    copyreg.pickle(_gp2.System, _reduce_system)  # type: ignore[arg-type]
    copyreg.pickle(_gp2.Posterior, _reduce_posterior)  # type: ignore[arg-type]
    # pprint wants a __repr__ with a hash; that of a class from C++ has none
    for described in vars(_gp2).values():
        if isinstance(described, type) and "__repr__" in vars(described):
            setattr(described, "__repr__", _with_hash(described.__repr__))


_prepare()
