"""Store and restore parameters of the emulated drive (1010h, 1011h), and what happens when the store is damaged."""

import pytest
from drive_bench import MS, Bench, decode_bench_image, described

from sim_drive.communication.parameters import (
    MemoryParameterStore,
    ParametersLost,
    ParameterStoreError,
    StoredParameters,
)
from sim_drive.device.drive import Drive
from sim_drive.settings import DriveSettings

SAVE, LOAD = "23{index}10{sub:02X}73617665", "23{index}10{sub:02X}6C6F6164"
CANNOT_STORE = 0x08000020
HARDWARE_ERROR = 0x06060000


class StubbornStore:
    """Lets itself be read, and not be written."""

    def __init__(self, stored: StoredParameters | None = None, reason: str | None = None) -> None:
        self.stored = stored
        self.reason = reason

    def load(self) -> StoredParameters | None:
        if self.reason is not None:
            raise ParameterStoreError(self.reason)
        return self.stored

    def save(self, parameters: StoredParameters) -> None:
        raise ParameterStoreError("the chip is worn out")


class StoringBench(Bench):
    """A bench whose drive may be taken out and put in again with the same store."""

    def __init__(self, store: object, settings: DriveSettings | None = None) -> None:
        super().__init__(settings, boot=False)
        self._settings = settings or DriveSettings()
        self.drive = Drive(5, described(5), self._settings, decode_bench_image, store)
        self._store = store
        self.drive.wake(0)

    def power_cycle(self) -> list[str]:
        self.drive = Drive(5, described(5), self._settings, decode_bench_image, self._store)
        self.drive.wake(self.now_ns)
        return self.sent()


@pytest.fixture
def bench() -> StoringBench:
    bench = StoringBench(MemoryParameterStore())
    assert bench.sent() == ["705#00"]
    return bench


def save(bench: Bench, subindex: int = 1) -> int:
    return bench.write(0x1010, subindex, 0x65766173, 4)


def load(bench: Bench, subindex: int = 1) -> int:
    return bench.write(0x1011, subindex, 0x64616F6C, 4)


# -- the objects -------------------------------------------------------------------------------------------------------


def test_signatures_are_the_standards_bytes(bench: StoringBench):
    assert bench.sdo("2310100173617665") == "6010100100000000"  # "save"
    assert bench.sdo("231110016C6F6164") == "6011100100000000"  # "load"


@pytest.mark.parametrize("index", [0x1010, 0x1011])
def test_wrong_signatures_are_refused_and_the_capability_reads_back(bench: StoringBench, index: int):
    assert bench.read(index, 0) == 4
    for subindex in (1, 2, 3, 4):
        for wrong in (0, 1, 0x73617665, 0x64616F6C if index == 0x1010 else 0x65766173):
            assert bench.write(index, subindex, wrong, 4) == CANNOT_STORE
        assert bench.read(index, subindex) == 1
    assert save(bench) == load(bench) == 0
    assert bench.read(index, 1) == 1
    assert bench.read_abort(index, 5) == 0x06090011


# -- what it does ------------------------------------------------------------------------------------------------------


def change(bench: Bench) -> None:
    bench.must(0x1017, 0, 250, 2)
    bench.must(0x6065, 0, 77, 4)
    bench.must(0x3020, 1, 1234, 4)


def values(bench: Bench) -> tuple[int, int, int]:
    return bench.read(0x1017), bench.read(0x6065), bench.read(0x3020, 1)


DEFAULTS, CHANGED = (0, 512, 256), (250, 77, 1234)


def test_without_saving_a_power_cycle_loses_it_all(bench: StoringBench):
    change(bench)
    bench.power_cycle()
    assert values(bench) == DEFAULTS


def test_saved_parameters_are_there_after_resets_and_power_cycles(bench: StoringBench):
    change(bench)
    assert save(bench) == 0
    bench.must(0x6065, 0, 88, 4)
    bench.nmt(0x81)
    assert values(bench) == CHANGED
    bench.power_cycle()
    assert values(bench) == CHANGED
    assert bench.drive.axis.gains[0] == 1234  # not in the dictionary alone
    assert bench.run(250 * MS) == ["705#7F"]
    bench.drive.switch_off(bench.now_ns)
    bench.drive.switch_on(bench.now_ns)
    bench.drive.wake(bench.now_ns)
    assert values(bench) == CHANGED


def test_reset_communication_brings_back_its_own_area_alone(bench: StoringBench):
    change(bench)
    save(bench)
    bench.must(0x1017, 0, 999, 2)
    bench.must(0x6065, 0, 88, 4)
    bench.nmt(0x82)
    assert values(bench) == (250, 88, 1234)


@pytest.mark.parametrize(
    ("subindex", "kept"), [(1, CHANGED), (2, (250, 512, 256)), (3, (0, 77, 256)), (4, (0, 512, 1234))]
)
def test_areas_are_saved_by_themselves(bench: StoringBench, subindex: int, kept: tuple[int, int, int]):
    change(bench)
    assert save(bench, subindex) == 0
    bench.power_cycle()
    assert values(bench) == kept


@pytest.mark.parametrize(
    ("subindex", "left"), [(1, DEFAULTS), (2, (0, 77, 1234)), (3, (250, 512, 1234)), (4, (250, 77, 256))]
)
def test_restoring_acts_after_the_next_reset(bench: StoringBench, subindex: int, left: tuple[int, int, int]):
    change(bench)
    save(bench)
    assert load(bench, subindex) == 0
    assert values(bench) == CHANGED
    bench.nmt(0x81)
    assert values(bench) == left
    bench.power_cycle()
    assert values(bench) == left


def test_saving_one_area_leaves_what_was_saved_of_another(bench: StoringBench):
    change(bench)
    save(bench)
    bench.must(0x1017, 0, 300, 2)
    bench.must(0x6065, 0, 300, 4)
    save(bench, 2)
    bench.power_cycle()
    assert values(bench) == (300, 77, 1234)


def test_pdos_come_up_as_they_were_saved(bench: StoringBench):
    bench.map_tpdo(2, 0x290, 1, [0x60640020, 0x60770010])
    bench.map_rpdo(3, 0x310, 1, [0x60660010])
    save(bench)
    bench.power_cycle()
    bench.nmt(0x01)
    assert bench.put(0x310, "4400") == []
    assert "290#000000000000" in bench.sync()
    assert bench.read(0x6066) == 0x44


def test_commands_and_demands_are_no_parameters(bench: StoringBench):
    assert bench.download(0x3001, 1, b"OK" + bytes(16)) == 0
    bench.must(0x3001, 2, 1, 1)
    bench.must(0x3010, 0, 2, 1)
    bench.enable()
    bench.must(0x607A, 0, 5000, 4)
    bench.must(0x60FF, 0, 5000, 4)
    bench.must(0x60B0, 0, 5, 4)
    bench.drive.warn(0x2310, 0x02, bench.now_ns)
    save(bench)
    bench.power_cycle()
    bench.tick()
    assert bench.statusword & 0x6F == 0x40
    assert [bench.read(index) for index in (0x6040, 0x6060, 0x607A, 0x60FF, 0x60B0, 0x3010, 0x1003)] == [0] * 7


def test_saving_the_defaults_changes_nothing(bench: StoringBench):
    bench.tick()
    before = {(e.variable.index, e.variable.subindex): e.value for e in bench.drive.dictionary}
    save(bench)
    assert len(bench._store.load().values) > 150
    bench.power_cycle()
    bench.tick()
    assert {(e.variable.index, e.variable.subindex): e.value for e in bench.drive.dictionary} == before


def test_identity_and_settings_stay_the_drives_own(bench: StoringBench):
    save(bench)
    again = StoringBench(bench._store, DriveSettings(counts_per_revolution=8192))
    assert again.read(0x608F, 1) == 8192


# -- when the store fails ----------------------------------------------------------------------------------------------


def test_store_that_cannot_be_written_is_told():
    bench = StoringBench(StubbornStore())
    bench.sent()
    assert save(bench) == HARDWARE_ERROR
    assert load(bench) == HARDWARE_ERROR
    bench.power_cycle()
    assert values(bench) == DEFAULTS


def test_damaged_store_means_defaults_an_emcy_and_a_sentence():
    bench = StoringBench(StubbornStore(reason="drive.json: damaged"))
    assert bench.sent() == ["705#00", "085#1063210000000000"]
    assert values(bench) == DEFAULTS
    assert bench.read(0x1001) == 0x21
    assert bench.read(0x1003, 1) == 0x6310
    lost = [event for event in bench.drive.take_events() if isinstance(event, ParametersLost)]
    assert lost == [ParametersLost(0, 5, "drive.json: damaged")]
    # It is told again after each reset of the node, as long as it is so, and does not keep the axis from working.
    assert bench.nmt(0x81) == ["705#00", "085#1063210000000000"]
    bench.tick()
    bench.enable()


def test_saving_anew_ends_the_loss():
    class OnceDamagedStore(MemoryParameterStore):
        def load(self) -> StoredParameters | None:
            if self._saved is None:
                raise ParameterStoreError("damaged")
            return super().load()

    bench = StoringBench(OnceDamagedStore())
    assert bench.sent() == ["705#00", "085#1063210000000000"]
    change(bench)
    assert save(bench) == 0
    assert bench.aside == ["085#0000000000000000"]
    assert bench.power_cycle() == ["705#00"]
    assert values(bench) == CHANGED


@pytest.mark.parametrize(
    ("place", "data", "reason"),
    [
        ((0x2345, 0), b"\0", "2345h:00 is stored, which is no parameter of this drive"),
        ((0x6041, 0), b"\0\0", "6041h:00 is stored, which is no parameter of this drive"),
        ((0x6040, 0), b"\x0f\0", "6040h:00 is stored, which is no parameter of this drive"),
        ((0x1017, 0), b"\0\0\0\0", "1017h:00 is stored with 4 bytes, but has 2"),
        ((0x605A, 0), b"\x09\0", "605Ah:00 is stored as 9, outside "),
        ((0x6085, 0), bytes(4), "6085h:00 is stored as 0, outside 1 to 4294967295"),
    ],
)
def test_what_does_not_fit_the_dictionary_is_damage(place: tuple[int, int], data: bytes, reason: str):
    stored = StoredParameters({(0x6065, 0): b"\x4d\0\0\0", place: data})
    bench = StoringBench(StubbornStore(stored))
    assert bench.sent() == ["705#00", "085#1063210000000000"]
    assert bench.read(0x6065) == 512  # not a part of it is used
    (lost,) = [event for event in bench.drive.take_events() if isinstance(event, ParametersLost)]
    assert lost.reason.startswith(reason)
