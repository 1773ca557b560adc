"""What this machine offers a loop that must be on time, and its CAN interfaces: findings, each with a remedy.

Everything is read from the kernel's files under ``root``, and from what ``ip`` and the kernel say of interfaces;
nothing is changed.
"""

import json
import os
import resource
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final

from drivers.hardware_stamps import why_no_hardware_stamps
from drivers.real_time import isolated_processors, tighten_timers

PRIORITY: Final = 80
"""SCHED_FIFO priority that the loop asks for."""
SAMPLE_POINTS: Final = (0.85, 0.90)
"""CiA 301 wants the sample point at 87.5 % of the bit, or close to it."""
LEAST_QUEUE: Final = 32
"""Frames that a transmit queue should hold; the kernel's own default for CAN, 10, is a burst of SDO."""
LEAST_RESTART_MS: Final = 50
"""Drives that miss SYNC have stopped by then; before, frames from before bus-off would move them."""
_CAP_NET_ADMIN: Final = 12
_CAP_IPC_LOCK: Final = 14
_CAP_SYS_NICE: Final = 23
_AF_CAN: Final = 29
_CAN_BCM: Final = 2


class Topic(Enum):
    """What is looked at."""

    PREEMPTION = "kernel preemption"
    PRIORITY = "real-time priority"
    THROTTLING = "real-time throttling"
    LOCKED_MEMORY = "locked memory"
    GOVERNOR = "frequency governor"
    ISOLATED = "isolated processors"
    TIMER_SLACK = "timer slack"
    IDLE_LATENCY = "idle states"
    SOCKETCAN = "SocketCAN"
    BROADCAST_MANAGER = "SYNC from the kernel"
    INTERFACE = "CAN interface"
    BIT_RATE = "bit rate"
    SAMPLE_POINT = "sample point"
    QUEUE = "transmit queue"
    RESTART = "restart after bus-off"
    TIMESTAMPS = "timestamps"


class Verdict(Enum):
    """How a finding is to be taken."""

    GOOD = "good"
    ADVICE = "advice"
    """It works; it would be better otherwise."""
    PROBLEM = "problem"
    """A run on this bus will not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at; ``remedy`` is empty where there is nothing to do."""

    topic: Topic
    where: str
    """The interface, or empty."""
    verdict: Verdict
    found: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a configuration needs; None: no configuration was given."""

    channel: str | None = None
    bit_rate: int | None = None
    is_virtual: bool = False


IpLink = Callable[[], list[dict[str, Any]]]


def ip_links() -> list[dict[str, Any]]:
    """What ``ip`` says of all interfaces, with details; empty where there is no ``ip``."""
    program = shutil.which("ip") or shutil.which("ip", path="/usr/sbin:/sbin")
    if program is None:
        return []
    command = [program, "-json", "-details", "link", "show"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
        return [dict(link) for link in json.loads(done.stdout)]
    except (OSError, subprocess.SubprocessError, ValueError, TypeError):
        return []


def examine(wanted: Wanted | None = None, root: Path = Path("/"), links: IpLink = ip_links) -> list[Finding]:
    """Look at everything; never raises for what it cannot read."""
    wanted = wanted or Wanted()
    return [*host_findings(root), *can_findings(wanted, root, links())]


def is_ready(findings: Iterable[Finding]) -> bool:
    """Whether nothing stands in the way of a run."""
    return all(finding.verdict is not Verdict.PROBLEM for finding in findings)


def findings_json(findings: list[Finding]) -> dict[str, Any]:
    """Stable keys."""
    rows = [{**asdict(finding), "topic": finding.topic.value, "verdict": finding.verdict.value} for finding in findings]
    return {"is_ready": is_ready(findings), "findings": rows}


# -- the host ----------------------------------------------------------------------------------------------------


def host_findings(root: Path) -> list[Finding]:
    """The kernel, the limits of this user, and the processors."""
    return [
        _preemption(root),
        _priority(root),
        _throttling(root),
        _locked_memory(root),
        _governor(root),
        _isolated(root),
        _timer_slack(root),
        _idle_latency(root),
    ]


def _preemption(root: Path) -> Finding:
    topic = Topic.PREEMPTION
    version = _read(root / "proc/version")
    if _read(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding(topic, "", Verdict.GOOD, "PREEMPT_RT")
    chosen = _read(root / "sys/kernel/debug/sched/preempt")
    if "(" in chosen:
        model = chosen.partition("(")[2].partition(")")[0]
        found = f"PREEMPT_DYNAMIC, {model}"
    else:
        model = next((name for name in ("PREEMPT_DYNAMIC", "PREEMPT") if name in version), "")
        found = model or "none, or voluntary"
    remedy = "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64)"
    if model not in ("full", "PREEMPT"):
        remedy += ", or boot with preempt=full"
    return Finding(topic, "", Verdict.ADVICE, found, remedy)


def _priority(root: Path) -> Finding:
    topic = Topic.PRIORITY
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if _has_capability(root, _CAP_SYS_NICE):
        return Finding(topic, "", Verdict.GOOD, "CAP_SYS_NICE: any priority")
    if limit == resource.RLIM_INFINITY or limit >= PRIORITY:
        return Finding(topic, "", Verdict.GOOD, f"limit {limit}")
    remedy = f"'@realtime - rtprio {PRIORITY + 10}' in /etc/security/limits.d/realtime.conf, and join that group"
    return Finding(topic, "", Verdict.ADVICE, f"limit {limit}, the loop asks for {PRIORITY}", remedy)


def _throttling(root: Path) -> Finding:
    topic = Topic.THROTTLING
    runtime, period = (_read(root / f"proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
    if not runtime:
        return Finding(topic, "", Verdict.GOOD, "not told by this kernel")
    if runtime == "0":
        return Finding(topic, "", Verdict.ADVICE, "no real-time share", "sysctl kernel.sched_rt_runtime_us=950000")
    return Finding(topic, "", Verdict.GOOD, "off" if runtime == "-1" else f"{runtime} us of every {period} us")


def _locked_memory(root: Path) -> Finding:
    topic = Topic.LOCKED_MEMORY
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit == resource.RLIM_INFINITY or _has_capability(root, _CAP_IPC_LOCK):
        return Finding(topic, "", Verdict.GOOD, "no limit")
    remedy = "'@realtime - memlock unlimited' in /etc/security/limits.d/realtime.conf, and join that group"
    return Finding(topic, "", Verdict.ADVICE, f"limit {limit // 1024} KiB", remedy)


def _governor(root: Path) -> Finding:
    topic = Topic.GOVERNOR
    files = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({_read(file) for file in files} - {""})
    if not governors:
        return Finding(topic, "", Verdict.GOOD, "no frequency scaling here")
    if governors == ["performance"]:
        return Finding(topic, "", Verdict.GOOD, "performance")
    return Finding(topic, "", Verdict.ADVICE, ", ".join(governors), "cpupower frequency-set -g performance")


def _isolated(root: Path) -> Finding:
    topic = Topic.ISOLATED
    isolated = isolated_processors(root / "sys/devices/system/cpu")
    if isolated:
        return Finding(topic, "", Verdict.GOOD, f"{', '.join(map(str, isolated))}; the loop binds itself to the first")
    remedy = "boot with isolcpus=N nohz_full=N rcu_nocbs=N for a processor N of the loop's own"
    return Finding(topic, "", Verdict.ADVICE, "none", remedy)


def _timer_slack(root: Path) -> Finding:
    slack = _read(root / "proc/self/timerslack_ns")
    now = f"{slack} ns for this process; " if slack else ""
    # The slack is a thread's own: what a thread that ends here is given shows whether the loop will be.
    with ThreadPoolExecutor(max_workers=1) as threads:
        setting = threads.submit(tighten_timers).result()
    if setting.is_on:
        return Finding(Topic.TIMER_SLACK, "", Verdict.GOOD, f"{now}the loop sets 1 ns for itself")
    remedy = "let prctl(PR_SET_TIMERSLACK) pass, which a container's seccomp profile may withhold"
    return Finding(Topic.TIMER_SLACK, "", Verdict.ADVICE, f"{now}the loop cannot change it ({setting.reason})", remedy)


def _idle_latency(root: Path) -> Finding:
    topic = Topic.IDLE_LATENCY
    device = root / "dev/cpu_dma_latency"
    if not device.exists():
        return Finding(topic, "", Verdict.GOOD, "this kernel has no /dev/cpu_dma_latency (a virtual machine?)")
    if os.access(device, os.W_OK):
        return Finding(topic, "", Verdict.GOOD, "may be held at 0 us")
    remedy = 'a udev rule: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'
    return Finding(topic, "", Verdict.ADVICE, "/dev/cpu_dma_latency may not be written", remedy)


# -- CAN ---------------------------------------------------------------------------------------------------------


def can_findings(wanted: Wanted, root: Path, links: list[dict[str, Any]]) -> list[Finding]:
    """SocketCAN, its broadcast manager, and every CAN interface."""
    net = root / "sys/class/net"
    names = sorted(path.parent.name for path in net.glob("*/type") if _read(path) == "280")
    by_name = {str(link.get("ifname")): link for link in links}
    findings = _socketcan(bool(names))
    for name in names:
        findings += interface_findings(name, by_name.get(name, {}), root, wanted)
    if wanted.channel is not None and wanted.channel not in names:
        remedy = f"'ip link add {wanted.channel} type vcan' for a virtual one, or an adapter and its driver"
        findings.append(
            Finding(
                Topic.INTERFACE, wanted.channel, Verdict.PROBLEM, "the configuration's channel is not there", remedy
            )
        )
    return findings


def _socketcan(has_interfaces: bool) -> list[Finding]:
    try:
        socket.socket(_AF_CAN, socket.SOCK_RAW, 1).close()
    except OSError:
        remedy = "a kernel with CONFIG_CAN; without one use -i socketcand, or another interface of python-can"
        return [Finding(Topic.SOCKETCAN, "", Verdict.ADVICE, "no CAN here: this kernel has none", remedy)]
    found = "there" if has_interfaces else "there, but no CAN interface"
    remedy = "" if has_interfaces else "modprobe vcan && ip link add vcan0 type vcan && ip link set vcan0 up"
    findings = [Finding(Topic.SOCKETCAN, "", Verdict.GOOD if has_interfaces else Verdict.ADVICE, found, remedy)]
    try:
        socket.socket(_AF_CAN, socket.SOCK_DGRAM, _CAN_BCM).close()
    except OSError:
        remedy = "modprobe can-bcm; until then the loop sends SYNC itself"
        findings.append(Finding(Topic.BROADCAST_MANAGER, "", Verdict.ADVICE, "no broadcast manager", remedy))
    else:
        findings.append(Finding(Topic.BROADCAST_MANAGER, "", Verdict.GOOD, "broadcast manager"))
    return findings


def interface_findings(name: str, link: dict[str, Any], root: Path, wanted: Wanted) -> list[Finding]:
    """One interface: ``link`` is what ``ip`` says of it (or nothing), ``root`` holds the kernel's files."""
    folder = root / "sys/class/net" / name
    info: dict[str, Any] = link.get("linkinfo") or {}
    data: dict[str, Any] = info.get("info_data") or {}
    is_virtual = info.get("info_kind") in ("vcan", "vxcan") or "virtual" in folder.resolve().parts
    findings = [_state(name, data, folder), _timestamps(name)]
    if is_virtual:
        findings.append(Finding(Topic.BIT_RATE, name, Verdict.GOOD, "virtual: none, frames take no time"))
    elif data:
        findings += [_bit_rate(name, data, wanted), _sample_point(name, data), _restart(name, data, root)]
    else:
        found = "unknown: there is no ip, or it tells nothing"
        findings.append(Finding(Topic.BIT_RATE, name, Verdict.ADVICE, found, "install iproute2"))
    length = _number(_read(folder / "tx_queue_len"))
    if length is not None:
        good = is_virtual or length >= LEAST_QUEUE
        remedy = "" if good else f"ip link set {name} txqueuelen 100"
        findings.append(
            Finding(Topic.QUEUE, name, Verdict.GOOD if good else Verdict.ADVICE, f"{length} frames", remedy)
        )
    return findings


def _timestamps(name: str) -> Finding:
    reason = why_no_hardware_stamps(name)
    found = f"the kernel's: {reason}" if reason else "by the controller's own clock"
    return Finding(Topic.TIMESTAMPS, name, Verdict.GOOD, found)


def _state(name: str, data: dict[str, Any], folder: Path) -> Finding:
    topic = Topic.INTERFACE
    if not (_number(_read(folder / "flags"), 16) or 0) & 1:
        return Finding(topic, name, Verdict.PROBLEM, "down", f"ip link set {name} up")
    state = str(data.get("state", "")).upper()
    if state == "BUS-OFF":
        remedy = f"look at wiring, termination and bit rate, then: ip link set {name} type can restart"
        return Finding(topic, name, Verdict.PROBLEM, "bus-off", remedy)
    if state in ("ERROR-WARNING", "ERROR-PASSIVE"):
        remedy = "look at wiring, termination (120 ohms at both ends) and the other nodes' bit rate"
        return Finding(topic, name, Verdict.ADVICE, f"up, {state.lower()}", remedy)
    return Finding(topic, name, Verdict.GOOD, f"up, {state.lower()}" if state else "up")


def _bit_rate(name: str, data: dict[str, Any], wanted: Wanted) -> Finding:
    topic = Topic.BIT_RATE
    timing: dict[str, Any] = data.get("bittiming") or {}
    rate = timing.get("bitrate")
    if not isinstance(rate, int) or rate <= 0:
        remedy = f"ip link set {name} type can bitrate {wanted.bit_rate or 1_000_000}"
        return Finding(topic, name, Verdict.PROBLEM, "not set", remedy)
    if wanted.bit_rate is not None and wanted.channel == name and rate != wanted.bit_rate:
        remedy = f"ip link set {name} down && ip link set {name} type can bitrate {wanted.bit_rate} && "
        remedy += f"ip link set {name} up; or correct bus.bit_rate"
        found = f"{rate} bit/s, the configuration says {wanted.bit_rate}"
        return Finding(topic, name, Verdict.PROBLEM, found, remedy)
    return Finding(topic, name, Verdict.GOOD, f"{rate} bit/s")


def _sample_point(name: str, data: dict[str, Any]) -> Finding:
    topic = Topic.SAMPLE_POINT
    timing: dict[str, Any] = data.get("bittiming") or {}
    try:
        point = float(timing["sample_point"])
    except (KeyError, TypeError, ValueError):
        remedy = f"a driver that tells its bit timing to 'ip -details link show {name}'; else see in the adapter's "
        remedy += "manual that it samples at 87.5 %, as CiA 301 wants it"
        return Finding(topic, name, Verdict.ADVICE, "unknown: the driver does not tell it", remedy)
    if SAMPLE_POINTS[0] <= point <= SAMPLE_POINTS[1]:
        return Finding(topic, name, Verdict.GOOD, f"{point:.1%}")
    remedy = f"ip link set {name} type can bitrate ... sample-point 0.875, as CiA 301 wants it"
    return Finding(topic, name, Verdict.ADVICE, f"{point:.1%}", remedy)


def _restart(name: str, data: dict[str, Any], root: Path) -> Finding:
    topic = Topic.RESTART
    restart_ms = data.get("restart_ms", 0)
    if isinstance(restart_ms, int) and 0 < restart_ms < LEAST_RESTART_MS:
        remedy = f"ip link set {name} type can restart-ms 100, with the interface down: the drives have to stop before"
        return Finding(
            topic, name, Verdict.ADVICE, f"after {restart_ms} ms, queued frames then still move drives", remedy
        )
    if isinstance(restart_ms, int) and restart_ms > 0:
        return Finding(topic, name, Verdict.GOOD, f"after {restart_ms} ms")
    remedy = f"ip link set {name} type can restart-ms 100, with the interface down"
    if _has_capability(root, _CAP_NET_ADMIN):
        return Finding(topic, name, Verdict.GOOD, "by the gateway itself, which has CAP_NET_ADMIN")
    return Finding(topic, name, Verdict.ADVICE, "by hand: the gateway has no CAP_NET_ADMIN to do it", remedy)


# -- reading -----------------------------------------------------------------------------------------------------


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _number(text: str, base: int = 10) -> int | None:
    try:
        return int(text, base)
    except ValueError:
        return None


def _has_capability(root: Path, number: int) -> bool:
    for line in _read(root / "proc/self/status").splitlines():
        if line.startswith("CapEff:"):
            return bool((_number(line.split()[1], 16) or 0) >> number & 1)
    return False
