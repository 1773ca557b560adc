"""EDS files: the one that ships, and bad ones."""

import re
from pathlib import Path

import pytest

from drivers.eds import MAX_EDS_BYTES, load_eds
from drivers.errors import EdsError
from drivers.object_dictionary import Access, DataType, ObjectCode, Variable

EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"
HEAD = "[DeviceInfo]\nVendorName=x\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "device.eds"
    path.write_text(text, encoding="utf-8")
    return path


def test_node_id_is_put_into_cob_ids():
    for node_id in (1, 42, 127):
        dictionary = load_eds(EDS, node_id)
        assert dictionary.get(0x1014, 0).default == 0x80 + node_id
        assert dictionary.get(0x1200, 1).default == 0x600 + node_id
        assert dictionary.get(0x1400, 1).default == 0x200 + node_id
        assert dictionary.get(0x1402, 1).default == 0x80000400 + node_id
        assert dictionary.get(0x1800, 1).default == 0x40000180 + node_id


def test_variables_carry_type_access_limits_and_mapping():
    dictionary = load_eds(EDS, 5)
    assert dictionary.get(0x1000, 0).default == 0x00020192
    assert dictionary.get(0x60C2, 2) == Variable(
        0x60C2, 2, "Interpolation time index", DataType.INTEGER8, Access.READ_WRITE, -3, -6, -1, False
    )
    controlword = dictionary.get(0x6040, 0)
    assert controlword.access is Access.READ_WRITE_PROCESS_OUTPUT
    assert controlword.is_pdo_mappable
    assert dictionary.get(0x607D, 1).default == -(1 << 31)
    assert dictionary.get(0x1008, 0).default == b"sim-drive"
    assert dictionary.get(0x3000, 1).data_type is DataType.DOMAIN
    assert dictionary.object_code(0x3000) is ObjectCode.RECORD
    assert dictionary.object_code(0x1016) is ObjectCode.ARRAY
    assert dictionary.object_code(0x6041) is ObjectCode.VARIABLE
    assert dictionary.name(0x6041) == "Statusword"
    assert dictionary.get(0x6041, 1) is None
    assert 0x5FFF not in dictionary


def test_dummy_types_may_be_mapped():
    dictionary = load_eds(EDS, 5)
    for index in range(1, 8):
        assert dictionary.get(index, 0).data_type == index
        assert dictionary.get(index, 0).is_pdo_mappable


def test_every_default_fits_its_own_limits_and_every_sub_index_zero_is_right():
    dictionary = load_eds(EDS, 5)
    for variable in dictionary:
        if variable.low_limit is not None:
            assert variable.low_limit <= variable.default <= variable.high_limit, variable
        if variable.subindex == 0 and dictionary.object_code(variable.index) is ObjectCode.RECORD:
            last = max(v.subindex for v in dictionary if v.index == variable.index)
            is_mapping = 0x1600 <= variable.index < 0x1800 or 0x1A00 <= variable.index < 0x1C00
            assert variable.default <= last if is_mapping else variable.default == last


def test_every_object_is_listed_once_and_only_once():
    text = EDS.read_text(encoding="ascii")
    listed = re.findall(r"^\d+=0x([0-9A-F]{4})$", text, re.MULTILINE)
    sections = re.findall(r"^\[([0-9A-F]{4})\]$", text, re.MULTILINE)
    assert sorted(listed) == sorted(sections)
    assert len(set(listed)) == len(listed)


def test_an_independent_linter_accepts_the_file():
    lint = pytest.importorskip("dcf.lint")
    parse = pytest.importorskip("dcf.parse")
    assert lint.lint(parse.parse_file(str(EDS)))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no section DeviceInfo"),
        ("Not an EDS at all", "no section DeviceInfo"),
        (HEAD, "describes no object"),
        (HEAD + "[1000]\nParameterName=a\nObjectType=0x7\nDataType=0x0007\n", "AccessType"),
        (HEAD + "[1000]\nParameterName=a\nDataType=0x0007\nAccessType=sometimes\n", "unknown access type"),
        (HEAD + "[1000]\nParameterName=a\nDataType=0x0007\nAccessType=ro\nDefaultValue=twelve\n", "no number"),
        (HEAD + "[1000]\nParameterName=a\nDataType=0x0005\nAccessType=ro\nDefaultValue=256\n", "does not fit"),
        (HEAD + "[1000]\nParameterName=a\nDataType=0x0007\n[1000]\nParameterName=b\n", "already exists"),
        (HEAD + "[1018sub1]\nParameterName=a\nDataType=0x0007\nAccessType=ro\n", "0x1018"),
        (HEAD + "ParameterName\n", "parsing errors"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(tmp_path: Path, text: str, reason: str):
    path = write(tmp_path, text)
    with pytest.raises(EdsError) as caught:
        load_eds(path, 5)
    assert str(path) in str(caught.value)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_folder_binary_and_huge_files_are_refused(tmp_path: Path):
    with pytest.raises(EdsError, match="No such file"):
        load_eds(tmp_path / "none.eds", 5)
    with pytest.raises(EdsError, match="directory"):
        load_eds(tmp_path, 5)
    binary = tmp_path / "binary.eds"
    binary.write_bytes(b"[DeviceInfo]\n\0\1\2")
    with pytest.raises(EdsError, match="not text"):
        load_eds(binary, 5)
    huge = tmp_path / "huge.eds"
    huge.write_bytes(b";" * (MAX_EDS_BYTES + 1))
    with pytest.raises(EdsError, match="larger than"):
        load_eds(huge, 5)


def test_twos_complement_and_unknown_types_of_other_vendors_are_taken(tmp_path: Path):
    path = write(
        tmp_path,
        HEAD
        + "[6064]\nParameterName=Pos\nDataType=0x0004\nAccessType=ro\nDefaultValue=0xFFFFFFFE\n"
        + "[2000]\nParameterName=Time\nDataType=0x000C\nAccessType=ro\nDefaultValue=0\n",
    )
    dictionary = load_eds(path, 5)
    assert dictionary.get(0x6064, 0).default == -2
    assert dictionary.get(0x2000, 0).data_type is DataType.DOMAIN


@pytest.mark.parametrize("node_id", [0, 128, -1])
def test_node_id_must_be_one(node_id: int):
    with pytest.raises(ValueError, match="node_id"):
        load_eds(EDS, node_id)
