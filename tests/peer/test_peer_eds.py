"""The shipped EDS before other people's readers: ``dcf-tools`` lints it, and three readers agree on what it says.

Ours stands on the parser of ``canopen``, so it is ``dcf-tools`` that judges independently.
"""

import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import canopen
import dcf
import pytest
from canopen.objectdictionary import ODVariable

from drivers.eds import load_eds
from drivers.object_dictionary import DataType
from sim_drive.logical_axes import eds_of_axes

EDS = Path(__file__).resolve().parent.parent.parent / "config" / "eds" / "sim_drive.eds"
PATIENCE_S = 60.0


def dcfchk(path: Path, node_id: int) -> subprocess.CompletedProcess[str]:
    program = shutil.which("dcfchk", path=str(Path(sys.executable).parent)) or shutil.which("dcfchk")
    assert program is not None, "dcf-tools is not installed"
    command = [program, "-n", str(node_id), str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.mark.parametrize("node_id", [1, 2, 127])
def test_dcfchk_has_nothing_to_say(node_id: int) -> None:
    done = dcfchk(EDS, node_id)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("[1000]\nParameterName=Device type\nObjectType=0x7", "[1000]\nParameterName=Device type\nObjectType=0x6"),
        ("SupportedObjects=3\n", "SupportedObjects=4\n"),
        ("LowLimit=-6\nHighLimit=-1\nDefaultValue=-3", "LowLimit=-6\nHighLimit=-4\nDefaultValue=-3"),
    ],
)
def test_dcfchk_would_find_a_mistake(tmp_path: Path, before: str, after: str) -> None:
    text = EDS.read_text()
    assert text.count(before) == 1
    broken = tmp_path / "broken.eds"
    broken.write_text(text.replace(before, after))
    done = dcfchk(broken, 1)
    assert done.returncode != 0 or done.stderr


@pytest.mark.parametrize("axes", [2, 8])
def test_dcfchk_has_nothing_to_say_about_several_axes(tmp_path: Path, axes: int) -> None:
    written = tmp_path / "axes.eds"
    written.write_text(eds_of_axes(EDS.read_text(), axes))
    done = dcfchk(written, 5)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("node_id", [1, 2, 127])
def test_three_readers_find_the_same_dictionary(node_id: int) -> None:
    ours = load_eds(EDS, node_id)
    theirs = canopen.RemoteNode(node_id, str(EDS)).object_dictionary
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        third = dcf.Device.from_dcf(str(EDS), {"NODEID": node_id})

    found: dict[tuple[int, int], tuple[object, ...]] = {}
    for variable in ours:
        default = None if variable.data_type is DataType.DOMAIN else variable.default
        limits = (variable.low_limit, variable.high_limit)
        found[variable.index, variable.subindex] = (
            int(variable.data_type),
            variable.access.value,
            default,
            limits,
            variable.is_pdo_mappable,
        )
    canopens: dict[tuple[int, int], tuple[object, ...]] = {}
    for entry in theirs.values():
        for v in [entry] if isinstance(entry, ODVariable) else entry.values():
            default = v.default.encode() if isinstance(v.default, str) else v.default
            canopens[v.index, v.subindex] = (v.data_type, v.access_type, default, (v.min, v.max), v.pdo_mappable)
    thirds: dict[tuple[int, int], tuple[object, ...]] = {}
    for index, entry in third.items():
        for subindex, sub in entry.items():
            thirds[index, subindex] = (sub.data_type.index, sub.access_type.name, sub.pdo_mapping)
            if DataType(sub.data_type.index) not in {DataType.DOMAIN, DataType.VISIBLE_STRING}:
                thirds[index, subindex] += (sub.parse_value(),)

    is_object = [place for place in found if place[0] >= 0x1000]
    assert set(is_object) == {place for place in canopens if place[0] >= 0x1000} == set(thirds)
    assert len(is_object) > 200
    assert {place: found[place] for place in is_object} == {place: canopens[place] for place in is_object}
    for place in is_object:
        data_type, access, default, _, is_mappable = found[place]
        expected = (data_type, access, is_mappable)
        if data_type not in {DataType.DOMAIN, DataType.VISIBLE_STRING}:
            expected += (default,)
        assert thirds[place] == expected, f"{place[0]:04X}h:{place[1]:02X}"


def test_the_default_pdos_are_those_of_the_profile() -> None:
    device = dcf.Device.from_dcf(str(EDS), {"NODEID": 2})
    tpdos = {n: (pdo.cob_id, [entry.index for entry in pdo.mapping.values()]) for n, pdo in device.tpdo.items()}
    rpdos = {n: (pdo.cob_id, [entry.index for entry in pdo.mapping.values()]) for n, pdo in device.rpdo.items()}
    assert tpdos == {
        1: (0x40000182, [0x6041]),
        2: (0xC0000282, [0x6041, 0x6061]),
        3: (0xC0000382, [0x6041, 0x6064]),
        4: (0xC0000482, [0x6041, 0x6064, 0x6077]),
    }
    assert rpdos == {
        1: (0x202, [0x6040]),
        2: (0x80000302, [0x6040, 0x6060]),
        3: (0x80000402, [0x6040, 0x607A]),
        4: (0x80000502, [0x6040, 0x607A, 0x60B2]),
    }
