"""Orders between processes: one word in the ring, the answer as an event, the command around both."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import CONSTANTS

from gateway.cyclic.operation import Order
from gateway.errors import GatewayError
from gateway.record.order_word import pack_order, unpack_order
from gateway.record.ring import RingReader, RingWriter, RunState
from gateway.running.control import send_order
from gateway.running.cyclic_process import pass_on_order

ROOT = Path(__file__).resolve().parent.parent.parent


@given(st.integers(0, 2**24 - 1), st.integers(1, 255), st.integers(-(2**31), 2**31 - 1))
def test_an_order_is_one_word(number, order, thousandths):
    word = pack_order(number, order, thousandths / 1000)
    assert 0 <= word < 2**64
    assert unpack_order(word) == (number, order, thousandths / 1000)


def test_a_value_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="is not within"):
        pack_order(1, 1, 2147484.0)


class Core:
    def __init__(self):
        self.orders = []

    def order(self, order, value):
        self.orders.append((order, value))


def test_the_loop_sees_every_order_once_and_nothing_else():
    core = Core()
    with RingWriter.create("orders", CONSTANTS) as ring, RingReader(ring.path) as reader:
        assert ring.order_word() == 0
        reader.send_order(Order.JOG, -6.5)
        first = ring.order_word()
        assert pass_on_order(core, first) == first
        reader.send_order(Order.JOG, -6.5)
        assert ring.order_word() != first
        pass_on_order(core, pack_order(9, 200, 1.0))
    assert core.orders == [(Order.JOG, -6.5)]


def test_an_order_is_answered_by_its_event(monkeypatch):
    with RingWriter.create("answered-orders", CONSTANTS) as ring:
        ring.set_state(RunState.RUNNING)

        def answer(_span_s):
            assert unpack_order(ring.order_word())[1:] == (Order.OVERRIDE, 50.0)
            ring.append_event(1, "order", "override 50 taken", order="override", value=50.0, refusal="")

        # The loop answers while the other side waits.
        monkeypatch.setattr("gateway.running.control.time.sleep", answer)
        assert send_order("answered-orders", Order.OVERRIDE, 50.0)["refusal"] == ""
        with pytest.raises(GatewayError, match="is not within"):
            send_order("answered-orders", Order.OVERRIDE, 1e12)
        ring.set_state(RunState.FINISHED)
        with pytest.raises(GatewayError, match="has ended"):
            send_order("answered-orders", Order.OVERRIDE, 50.0)


@pytest.mark.slow
def test_without_a_run_the_command_says_so_and_ends_with_1():
    command = [sys.executable, "-m", "gateway.cli", "control", "paper", "override", "50"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60, check=False)
    assert done.returncode == 1
    assert "no run of paper is going on" in done.stderr
