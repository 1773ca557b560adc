"""Dictionaries made for a row of nodes are those that the EDS file itself gives."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.eds import describe_any_node
from drivers.object_dictionary import ObjectDictionary
from sim_drive.node_row import describe_row

EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"
READ = describe_any_node(EDS)
ROW = describe_row(READ)


def seen(dictionary: ObjectDictionary) -> list[object]:
    return [(v, dictionary.object_code(v.index), dictionary.name(v.index)) for v in dictionary]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 127))
def test_every_node_has_the_dictionary_that_the_file_gives(node_id: int) -> None:
    assert seen(ROW(node_id)) == seen(READ(node_id))


def test_some_values_do_depend_on_the_node_id() -> None:
    cob_ids = [variable.default for variable in ROW(9) if (variable.index, variable.subindex) == (0x1800, 1)]
    assert cob_ids == [0x40000189]


@pytest.mark.parametrize("node_id", [0, 128])
def test_impossible_node_ids_are_refused_as_ever(node_id: int) -> None:
    with pytest.raises(ValueError, match="node_id must be 1 to 127"):
        ROW(node_id)


def test_a_dictionary_that_differs_in_another_way_is_read_every_time() -> None:
    calls: list[int] = []

    def describe(node_id: int) -> ObjectDictionary:
        calls.append(node_id)
        return READ(node_id if node_id != 2 else 5)

    assert describe_row(describe) is describe
    assert calls == [1, 2]
