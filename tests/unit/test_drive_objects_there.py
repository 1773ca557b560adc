"""Every object that a CiA 402 servo drive is asked for is in the dictionary of every axis, as the type it has to be."""

import pytest
from drive_bench import Bench

U8, U16, U32, I8, I16, I32 = 5, 6, 7, 2, 3, 4
OBJECTS: dict[tuple[int, int], int] = {
    (0x1001, 0): U8, (0x1003, 0): U8, (0x1005, 0): U32, (0x1006, 0): U32, (0x1007, 0): U32, (0x100C, 0): U16,
    (0x100D, 0): U8, (0x1010, 1): U32, (0x1011, 1): U32, (0x1012, 0): U32, (0x1014, 0): U32, (0x1015, 0): U16,
    (0x1016, 1): U32, (0x1017, 0): U16, (0x1018, 4): U32, (0x1019, 0): U8, (0x1029, 1): U8,
    (0x3050, 0): U16, (0x3051, 0): U32,
    (0x1403, 2): U8, (0x1603, 8): U32, (0x1803, 6): U8, (0x1A03, 8): U32,
    (0x6007, 0): I16, (0x603F, 0): U16, (0x6040, 0): U16, (0x6041, 0): U16, (0x605A, 0): I16, (0x605B, 0): I16,
    (0x605C, 0): I16, (0x605D, 0): I16, (0x605E, 0): I16, (0x6060, 0): I8, (0x6061, 0): I8, (0x6062, 0): I32,
    (0x6064, 0): I32, (0x6065, 0): U32, (0x6066, 0): U16, (0x6067, 0): U32, (0x6068, 0): U16, (0x606B, 0): I32,
    (0x606C, 0): I32, (0x606D, 0): U16, (0x606E, 0): U16, (0x606F, 0): U16, (0x6070, 0): U16, (0x6071, 0): I16,
    (0x6072, 0): U16, (0x6074, 0): I16, (0x6076, 0): U32, (0x6077, 0): I16, (0x607A, 0): I32, (0x607C, 0): I32,
    (0x607D, 1): I32, (0x607D, 2): I32, (0x607E, 0): U8, (0x607F, 0): U32, (0x6080, 0): U32, (0x6081, 0): U32,
    (0x6082, 0): U32, (0x6083, 0): U32, (0x6084, 0): U32, (0x6085, 0): U32, (0x6086, 0): I16, (0x6087, 0): U32,
    (0x608F, 1): U32, (0x608F, 2): U32, (0x6090, 1): U32, (0x6090, 2): U32, (0x6091, 1): U32, (0x6091, 2): U32,
    (0x6092, 1): U32, (0x6092, 2): U32, (0x6098, 0): I8, (0x6099, 1): U32, (0x6099, 2): U32, (0x609A, 0): U32,
    (0x60A3, 0): U8, (0x60A4, 1): U32, (0x60B0, 0): I32, (0x60B1, 0): I32, (0x60B2, 0): I16, (0x60B8, 0): U16,
    (0x60B9, 0): U16, (0x60BA, 0): I32, (0x60BB, 0): I32, (0x60BC, 0): I32, (0x60BD, 0): I32, (0x60C0, 0): I16,
    (0x60C1, 1): I32, (0x60C2, 1): U8, (0x60C2, 2): I8, (0x60C3, 1): U8, (0x60C3, 2): U8, (0x60C4, 1): U32,
    (0x60C5, 0): U32, (0x60C6, 0): U32, (0x60E0, 0): U16, (0x60E1, 0): U16, (0x60F2, 0): U16, (0x60F4, 0): I32,
    (0x60FD, 0): U32, (0x60FE, 1): U32, (0x60FE, 2): U32, (0x60FF, 0): I32, (0x6502, 0): U32, (0x67FF, 0): U32,
}  # fmt: skip
"""Data types of CiA 301 and CiA 402-2, by index and sub-index."""


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


def test_every_object_is_there_with_its_type(bench: Bench) -> None:
    found = {place: bench.drive.dictionary.get(*place) for place in OBJECTS}
    types = {place: None if entry is None else int(entry.data_type) for place, entry in found.items()}
    assert types == OBJECTS


@pytest.mark.parametrize("subindex", [1, 2])
def test_interpolation_is_in_step_with_every_sync(bench: Bench, subindex: int) -> None:
    # 60C3h:01 synchronises on SYNC (0), 60C3h:02 at each of them (1); a drive that can do no other takes no other.
    fixed = subindex - 1
    assert bench.read(0x60C3, subindex) == fixed
    assert bench.write(0x60C3, subindex, fixed, 1) == 0
    assert bench.write(0x60C3, subindex, fixed + 1, 1) == 0x06090031
