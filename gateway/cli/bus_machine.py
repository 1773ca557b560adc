"""A machine on a bus that is run again and again with other gains: what `gateway.tuning.on_machine` asks of one."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

from config.schema import GatewayConfig
from drivers.master import Master, Procedure
from drivers.real_time import run_node
from gateway.errors import GatewayError
from gateway.record.recording import read_recording
from gateway.running.bus_address import BusAddress
from gateway.running.drive_settings import build_master, node_settings
from gateway.running.preparation import PreparedRun
from gateway.running.procedure_core import ProcedureCore
from gateway.running.session import StopSwitch, run_realtime
from gateway.tuning.controller import GainPair
from gateway.tuning.gain_download import read_gains, write_gains
from gateway.tuning.on_machine import TrialRun, judge_trial
from mechanism.cam_file import cam_document


class BusMachine:
    """`gateway.tuning.on_machine.TrialMachine` on a bus; without a prepared run it only takes gains."""

    def __init__(
        self,
        config: GatewayConfig,
        address: BusAddress,
        prepared: PreparedRun | None = None,
        machine_cycles: int = 1,
        switch: StopSwitch | None = None,
    ) -> None:
        self._config = config
        self._address = address
        self._prepared = prepared
        self._machine_cycles = machine_cycles
        self._switch = StopSwitch() if switch is None else switch

    def read_gains(self) -> GainPair:
        """See `TrialMachine`."""
        return self._carry_out(lambda master: read_gains(master, node_settings(self._config)))

    def write_gains(self, gains: GainPair) -> None:
        """See `TrialMachine`."""
        self._carry_out(lambda master: write_gains(master, node_settings(self._config), gains))

    def _carry_out(self, make: Callable[[Master], Procedure[GainPair]]) -> GainPair:
        core = ProcedureCore(build_master(self._config), make)
        connection = self._address.open()
        try:
            run_node(core, connection, lambda: core.is_done)
        finally:
            connection.close()
        if core.failure is not None:
            raise core.failure
        if core.result is None:
            raise GatewayError("the drives did not answer")
        return core.result

    def run(self, gains: GainPair) -> TrialRun:
        """See `TrialMachine`."""
        if self._prepared is None:
            raise ValueError("this machine was not prepared for runs")
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder, "trial.mcap")
            run_realtime(
                self._prepared,
                self._address,
                recording,
                json.dumps(cam_document(self._prepared.cam)),
                self._switch,
                machine_cycles=self._machine_cycles,
            )
            read = read_recording(recording)
        return judge_trial(gains, read.samples, read.stopped_by)
