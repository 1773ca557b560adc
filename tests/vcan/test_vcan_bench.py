"""On a real vcan0: the gateway's loop, the canopen package's and a bare one with the same drives; who keeps SYNC best.

Printed, never asserted; ``-s`` shows it. ``DRIVE_GATEWAY_BENCH_CYCLE_US`` (4000) and ``DRIVE_GATEWAY_BENCH_S`` (4) set
the cycle and the seconds of each loop: ten minutes at 1 kHz are 1000 and 600.
"""

import itertools
import json
import os
import shutil
import socket
import statistics
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
import yaml
from peer_loops import bare_cycle, canopen_cycle, mapped_nodes, paced_us, waiting_for
from slow_host import LATENESS, slow_host_paper

from drivers.broadcast_manager import PeriodicFrame
from drivers.frame import Frame
from drivers.period_trim import WINDOW, PeriodTrim
from drivers.ports import interface_is_up, open_port
from drivers.real_time import tighten_timers

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.bench,
    pytest.mark.timeout(2400),
    pytest.mark.skipif(not interface_is_up("vcan0"), reason="there is no CAN interface vcan0 that is up"),
]

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE_S = 1800.0
CYCLE_US = int(os.environ.get("DRIVE_GATEWAY_BENCH_CYCLE_US", "4000"))
SPAN_S = float(os.environ.get("DRIVE_GATEWAY_BENCH_S", "4"))
SYNC_ROUNDS = 3
SETTLING = 2 * WINDOW
"""SYNCs until the kernel's period is right; they are left out."""
NODE_IDS = (1, 2)

C_LOOP = r"""
#include <linux/can.h>
#include <net/if.h>
#include <sched.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
int main(int count, char **words) {
    long left = atol(words[2]), period = atol(words[3]);
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct sockaddr_can place = {.can_family = AF_CAN, .can_ifindex = if_nametoindex(words[1])};
    struct can_frame sync = {.can_id = 0x80};
    struct timespec due;
    if (count < 4 || bus < 0 || bind(bus, (struct sockaddr *)&place, sizeof place)) return 1;
    struct sched_param first = {.sched_priority = 50};
    prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
    sched_setscheduler(0, SCHED_FIFO, &first);
    clock_gettime(CLOCK_MONOTONIC, &due);
    while (left--) {
        due.tv_nsec += period;
        while (due.tv_nsec >= 1000000000L) { due.tv_nsec -= 1000000000L; due.tv_sec++; }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, 0);
        if (write(bus, &sync, sizeof sync) != sizeof sync) return 2;
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``paper`` at the bench's cycle, its guards warning only."""
    config = slow_host_paper((*LATENESS, "following_error"))
    config["bus"] |= {"cycle_us": CYCLE_US, "heartbeat_timeout_ms": 1000, "is_virtual": True}
    config["guard"]["sync_lost"] = {"limit_cycles": 5, "reaction": "warn"}
    config["guard"]["unanswered_torque"] = {"limit_permille": 30000, "reaction": "disable"}
    path = tmp_path_factory.mktemp("bench") / "bench.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def gateway_cycle(drive_gateway: Callable[..., "subprocess.Popen[str]"], machine: Path, folder: Path) -> dict[str, Any]:
    cycles = max(1, round(SPAN_S))
    options = ("-i", "socketcan", "-c", "vcan0", "--cycles", cycles, "--record", "run.mcap", "--no-frames", "--json")
    process = drive_gateway("run", machine, *options, "--overwrite", folder=folder)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert output, (folder / "stderr").read_text()
    return json.loads(output)["cycle"]


def start_nodes(command: int) -> None:
    """The drives are as the gateway has left them: mapped, pre-operational."""
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        for node_id in NODE_IDS:
            bus.send(can.Message(arbitration_id=0, data=[command, node_id], is_extended_id=False))
    time.sleep(0.1)


def canopen_cycle_us() -> float:
    """The package's own way: a notifier's thread takes what comes, the loop sends SYNC and writes by name."""
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    nodes = mapped_nodes(network, NODE_IDS)
    cycle = canopen_cycle(network, nodes, waiting_for(nodes, CYCLE_US * 0.8e-6))
    spent_us = paced_us(cycle, round(SPAN_S * 1e6 / CYCLE_US), CYCLE_US * 1e-6)
    network.disconnect()
    return spent_us


def bare_cycle_us() -> float:
    """Raw sockets and struct: SYNC, wait for both TPDOs, both RPDOs, sleep."""
    tighten_timers()
    with socket.socket(29, socket.SOCK_RAW, 1) as bus:
        exact = b"".join(struct.pack("=II", 0x180 + node_id, 0xC00007FF) for node_id in NODE_IDS)
        bus.setsockopt(101, 1, exact)
        bus.settimeout(CYCLE_US * 0.8e-6)
        bus.bind(("vcan0",))
        cycle = bare_cycle(bus.send, bus.recv, NODE_IDS, 0)
        return paced_us(cycle, round(SPAN_S * 1e6 / CYCLE_US), CYCLE_US * 1e-6)


def test_cpu_a_cycle_against_the_same_drives(
    start_sim_drive: Callable[..., dict[str, Any]],
    drive_gateway: Callable[..., "subprocess.Popen[str]"],
    machine: Path,
    tmp_path: Path,
) -> None:
    start_sim_drive("--interface", "socketcan", "--channel", "vcan0", "--realtime", config=str(machine))
    cycle = gateway_cycle(drive_gateway, machine, tmp_path)
    start_nodes(0x01)
    others = [(canopen_cycle_us(), bare_cycle_us()) for _ in range(2)]
    start_nodes(0x80)
    package, bare = (min(figures) for figures in zip(*others, strict=True))
    ours = cycle["loop_cpu_us_per_cycle"]
    print(
        f"\n{CYCLE_US} us a cycle on vcan0, two axes, the same drives: gateway {ours:.0f} us of CPU a cycle (p50 "
        f"{cycle['spread_us']['loop_time']['p50']:.0f}), canopen {package:.0f}, bare {bare:.0f}; "
        f"gateway : canopen {ours / package:.2f}, gateway : bare {ours / bare:.2f}"
    )
    kept = ("count", "missed_tpdo", "missed_rpdo_deadline", "overruns", "sync_lost", "send_buffer_full")
    print("the gateway's account:", {name: cycle[name] for name in kept}, cycle["sync_period_deviation_us"])


def periods_us(count: int, run: Callable[[], None]) -> list[float]:
    """|period - 1 ms| of the SYNCs that ``run`` puts on the bus, by the kernel's stamps."""
    port = open_port("socketcan", "vcan0", filters=[(0x080, 0x7FF)])
    try:
        run()
        stamps: list[int] = []
        while len(stamps) < count + SETTLING:
            received = port.receive() or port.receive()
            if received is None:
                break
            stamps.append(received[1])
    finally:
        port.close()
    return [abs(after - before - 1_000_000) / 1000 for before, after in itertools.pairwise(stamps)]


def by_kernel(count: int) -> None:
    timer = PeriodicFrame("vcan0", Frame(0x080), 1000)
    timer.start()
    time.sleep(count * 1e-3)
    timer.close()


def by_trimmed_kernel(count: int) -> None:
    """As a run does it: whoever hears SYNC sets the kernel's timer to what makes the mean period right."""
    port = open_port("socketcan", "vcan0", filters=[(0x080, 0x7FF)])
    timer, trim = PeriodicFrame("vcan0", Frame(0x080), 1000), PeriodTrim(1000)
    timer.start()
    before_ns, left = 0, count + SETTLING
    while left:
        received = port.receive()
        if received is None:
            port.wait(1.0)
            continue
        left -= 1
        if before_ns and trim.observe(received[1] - before_ns):
            timer.retime(trim.interval_us)
        before_ns = received[1]
    timer.close()
    port.close()


def by_python(count: int) -> None:
    port = open_port("socketcan", "vcan0", filters=[])
    sync = Frame(0x080)
    due_ns = time.monotonic_ns()
    for _ in range(count):
        due_ns += 1_000_000
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        port.send(sync)
    port.close()


def test_sync_deviation_of_kernel_loop_and_c_loop_in_turns(tmp_path: Path) -> None:
    tighten_timers()
    count = 1500
    runs: dict[str, Callable[[], None]] = {
        "kernel (BCM)": lambda: by_kernel(count),
        "kernel, its period trimmed": lambda: by_trimmed_kernel(count),
        "Python loop": lambda: by_python(count),
    }
    if shutil.which("gcc"):
        source = tmp_path / "loop.c"
        source.write_text(C_LOOP)
        program = tmp_path / "loop"
        subprocess.run(["gcc", "-O2", "-o", str(program), str(source)], check=True, timeout=PATIENCE_S)
        command = [str(program), "vcan0", str(count), "1000000"]
        runs["C loop"] = lambda: subprocess.run(command, check=True, timeout=PATIENCE_S) and None
    found: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(SYNC_ROUNDS):
        for name, run in runs.items():
            found[name] += periods_us(count, run)[-count:]
    print()
    for name, deviations in found.items():
        if len(deviations) > 1:
            p50, p99 = statistics.median(deviations), statistics.quantiles(deviations, n=100)[98]
            print(f"|SYNC period - 1 ms|, {name}: p50 {p50:.1f} us, p99 {p99:.1f} us, of {len(deviations)}")
