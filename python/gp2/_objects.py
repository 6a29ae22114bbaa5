"""What Python expects of objects, and C++ does not give: copies, pickles, frames, notebooks, a __repr__ that pprint takes."""

from __future__ import annotations

import copyreg
import html
import importlib
import tempfile
from pathlib import Path
from typing import Any

from gp2 import _gp2


def _read_system(text: str, name: str, robot: str | None = None) -> _gp2.System:
    return _gp2.System.parse(text, name, robot)


# a system travels as text
def _reduce_system(system: _gp2.System) -> tuple[Any, ...]:
    if not _is_text(system):
        raise TypeError(f"'{system.name}' cannot be pickled: it has functions, which are code")
    return _read_system, (system.text, system.name, system.robot)


def _is_text(system: _gp2.System) -> bool:
    try:
        _read_system(system.text, system.name, system.robot)
        return True
    except _gp2.InputError:  # it has functions
        return False


def _are_equal(self: _gp2.System, other: object) -> Any:
    """__eq__(self: System, other: object) -> bool

    Whether their texts are equal; a system with functions is equal to itself alone.
    """
    if not isinstance(other, _gp2.System):
        return NotImplemented
    if self is other:
        return True
    return (self.name, self.text, self.robot) == (other.name, other.text, other.robot) and _is_text(self)


def _hash_of(self: _gp2.System) -> int:
    """__hash__(self: System) -> int

    Of its text.
    """
    return hash((self.name, self.text, self.robot))


def _read_posterior(content: bytes) -> _gp2.Posterior:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fit.json")
        path.write_bytes(content)
        return _gp2.load(path)


# a posterior travels as the content of its file
def _reduce_posterior(posterior: _gp2.Posterior) -> tuple[Any, ...]:
    _reduce_system(posterior.system)
    if posterior._has_code:
        raise TypeError(f"a fit of '{posterior.system.name}' that learned from another system's log cannot be pickled: that system has functions")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fit.json")
        posterior.save(path)
        return _read_posterior, (path.read_bytes(),)


def _frame(columns: dict[str, Any]) -> Any:
    return importlib.import_module("pandas").DataFrame(columns)  # which the package does not need


def _by_name(names: list[str], rows: Any) -> dict[str, Any]:
    return {name: rows[:, k] for k, name in enumerate(names)}


def _deviations(names: list[str], result: Any) -> dict[str, Any]:
    std = getattr(result, "std", None)  # a mean alone has none
    return {} if std is None else _by_name([f"{name}_std" for name in names], std)


def _table_frame(self: _gp2.Table) -> Any:
    """to_frame(self: Table) -> Any

    The columns as a pandas frame.
    """
    return _frame({name: self[name] for name in self.columns})


def _prediction_frame(self: _gp2.Prediction) -> Any:
    """to_frame(self: Prediction) -> Any

    Means, standard deviations as NAME_std, and the distance from the data, as a pandas frame.
    """
    columns = _by_name(self.names, self.mean) | _deviations(self.names, self)
    return _frame(columns | {"distance_from_data": self.distance_from_data})


def _inputs_frame(self: _gp2.Inputs) -> Any:
    """to_frame(self: Inputs) -> Any

    The inputs, with their standard deviations as NAME_std, as a pandas frame.
    """
    return _frame(_by_name(self.names, self.inputs) | _deviations(self.names, self))


def _motion_frame(self: _gp2.Motion) -> Any:
    """to_frame(self: Motion) -> Any

    The table, with the standard deviations of ddq as NAME_std and the distance from the data where there are, as a pandas frame.
    """
    table = self.table
    columns: dict[str, Any] = {name: table[name] for name in table.columns}
    if self.std is not None:
        nq = self.ddq.shape[1]
        accelerations = table.columns[1 + 2 * nq : 1 + 3 * nq]  # after t, q and dq
        columns |= _deviations(accelerations, self) | {"distance_from_data": self.distance_from_data}
    return _frame(columns)


def _in_a_notebook(shown: _gp2.System | _gp2.Posterior) -> str:
    try:
        return f"<pre>{html.escape(_gp2.show(shown))}</pre>"
    except _gp2.InputError:  # its mechanics are code
        return html.escape(repr(shown))


def _with_hash(described: Any) -> Any:
    return lambda self: described(self)


def _prepare() -> None:
    # what never changes is its own copy; what a Log or a SideInformation holds may change
    for fixed in (_gp2.System, _gp2.Table):
        setattr(fixed, "__copy__", lambda self: self)
        setattr(fixed, "__deepcopy__", lambda self, memo: self)
    setattr(_gp2.System, "__eq__", _are_equal)
    setattr(_gp2.System, "__hash__", _hash_of)
    copyreg.pickle(_gp2.System, _reduce_system)  # type: ignore[arg-type]
    copyreg.pickle(_gp2.Posterior, _reduce_posterior)  # type: ignore[arg-type]
    for shown in (_gp2.System, _gp2.Posterior):
        setattr(shown, "_repr_html_", _in_a_notebook)
    frames = {_gp2.Table: _table_frame, _gp2.Prediction: _prediction_frame, _gp2.Inputs: _inputs_frame, _gp2.Motion: _motion_frame}
    for one, to_frame in frames.items():
        setattr(one, "to_frame", to_frame)
    # pprint wants a __repr__ with a hash; that of a class from C++ has none
    for described in vars(_gp2).values():
        if isinstance(described, type) and "__repr__" in vars(described):
            setattr(described, "__repr__", _with_hash(described.__repr__))


_prepare()
