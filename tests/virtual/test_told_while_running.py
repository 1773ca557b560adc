"""A run whose servo drive trips tells its user so while it goes on, in the order in which it happens."""

import pytest

from config.loading import load_config
from gateway.cli.run_commands import _prepare, _run_virtually
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector


@pytest.fixture
def told(tmp_path, capsys):
    config = load_config("paper")
    prepared, cam = _prepare(config, 3)
    machine = Injector(build_machine(config), [Fault(FaultKind.OVER_CURRENT, 2, at_s=2.0)])
    _run_virtually(prepared, cam, tmp_path / "run.mcap", 0, False, False, machine=machine)
    return capsys.readouterr().err.splitlines()


def test_trip_quick_stop_and_recovery_are_told_in_their_order(told):
    expected = [
        "moving",
        "  node 2 EMCY 2310h, error register 03h",
        "  emergency on axis servo: 2310h, quick stop",
        "  quick stop",
        "  recovering the axes",
        "  axis cv: ready for a new run",
        "  axis servo: fault reset, ready for a new run",
        "done",
    ]
    assert [line for line in told if line in expected] == expected
    assert len(told) < 30
