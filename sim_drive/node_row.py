"""Object dictionaries of many nodes of one EDS file, without reading the file anew for each."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from drivers.nmt import MAX_NODE_ID
from drivers.object_dictionary import ObjectDictionary, Variable

_SAMPLES: Final = (1, 2)
"""Node ids whose dictionaries are compared."""

Describe = Callable[[int], ObjectDictionary]


def describe_row(describe: Describe) -> Describe:
    """Gives what ``describe`` gives, in a tenth of the time from the third call on.

    ``$NODEID`` can stand in an EDS file as a summand alone (CiA 306), so that a default value either is the same for
    all node ids or grows with them. Where two dictionaries differ in any other way, ``describe`` is asked every time.
    It raises as ``describe`` does.
    """
    first, second = (describe(node_id) for node_id in _SAMPLES)
    pairs = list(zip(first, second, strict=False))
    if len(first) != len(second) or not all(_is_alike(*pair) for pair in pairs):
        return describe
    codes = {variable.index: first.object_code(variable.index) for variable in first}
    names = {variable.index: first.name(variable.index) for variable in first}
    fixed = [variable for variable, other in pairs if variable == other]
    growing = [variable for variable, other in pairs if variable != other]

    def give(node_id: int) -> ObjectDictionary:
        if node_id in _SAMPLES or not 1 <= node_id <= MAX_NODE_ID:
            return describe(node_id)
        own = [replace(variable, default=_grown(variable, node_id)) for variable in growing]
        variables = {(variable.index, variable.subindex): variable for variable in (*fixed, *own)}
        return ObjectDictionary([variables[v.index, v.subindex] for v in first], codes, names)

    return give


def _is_alike(one: Variable, other: Variable) -> bool:
    if one == other:
        return True
    return isinstance(one.default, int) and other == replace(one, default=one.default + 1)


def _grown(variable: Variable, node_id: int) -> int:
    assert isinstance(variable.default, int)
    return variable.default + node_id - _SAMPLES[0]
