"""The doctor on machines that are folders, and on the one that runs the tests."""

import ctypes
import json

import pytest
from typer.testing import CliRunner

from drivers.real_time import RealTimeFeature, RealTimeSetting
from gateway.cli.app import app
from gateway.running import doctor
from gateway.running.doctor import Topic, Verdict, Wanted, can_findings, examine, findings_json, host_findings, is_ready

PR_GET_TIMERSLACK = 30
GOOD_CAN = {
    "ifname": "can0",
    "linkinfo": {
        "info_kind": "can",
        "info_data": {
            "state": "ERROR-ACTIVE",
            "restart_ms": 100,
            "bittiming": {"bitrate": 1000000, "sample_point": "0.875"},
        },
    },
}


def write(root, **files):
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")


def interface(root, name, flags="0x40081", queue="100", is_virtual=False):
    folder = root / "sys/devices" / ("virtual" if is_virtual else "pci") / "net" / name
    folder.mkdir(parents=True)
    for key, text in (("type", "280"), ("flags", flags), ("tx_queue_len", queue)):
        (folder / key).write_text(text + "\n")
    net = root / "sys/class/net"
    net.mkdir(parents=True, exist_ok=True)
    (net / name).symlink_to(folder)


def by_topic(findings, where=""):
    return {finding.topic: finding for finding in findings if finding.where == where}


@pytest.fixture(autouse=True)
def no_hardware_stamps(monkeypatch):
    monkeypatch.setattr(doctor, "why_no_hardware_stamps", lambda name: f"{name} has none")


def can(root, link, wanted=None):
    return by_topic(can_findings(wanted or Wanted(), root, [link]), "can0")


def test_a_real_time_kernel_has_nothing_to_be_told(tmp_path):
    write(
        tmp_path,
        proc__version="Linux version 6.12.0-rt",
        sys__kernel__realtime="1",
        sys__devices__system__cpu__isolated="3",
        sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="performance",
        proc__self__timerslack_ns="50000",
        proc__self__status="Name: x\nCapEff:\t000001ffffffffff",
        proc__sys__kernel__sched_rt_runtime_us="-1",
    )
    findings = host_findings(tmp_path)
    assert {finding.verdict for finding in findings} == {Verdict.GOOD}
    assert not any(finding.remedy for finding in findings)
    assert by_topic(findings)[Topic.PREEMPTION].found == "PREEMPT_RT"


def test_an_ordinary_machine_is_given_a_remedy_for_each(tmp_path, monkeypatch):
    write(
        tmp_path,
        proc__version="Linux version 6.1 SMP PREEMPT_DYNAMIC Debian",
        sys__kernel__debug__sched__preempt="none (voluntary) full",
        sys__devices__system__cpu__isolated="",
        sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="powersave",
        sys__devices__system__cpu__cpu1__cpufreq__scaling_governor="performance",
        proc__self__status="CapEff:\t0000000000000000",
        proc__sys__kernel__sched_rt_runtime_us="0",
    )
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda _: (64 * 1024, 64 * 1024))
    findings = by_topic(host_findings(tmp_path))
    worse = {topic for topic, finding in findings.items() if finding.verdict is Verdict.ADVICE}
    expected = {Topic.PREEMPTION, Topic.THROTTLING, Topic.LOCKED_MEMORY, Topic.GOVERNOR, Topic.ISOLATED}
    assert worse == expected, "64 k as a priority limit is enough"
    assert all(findings[topic].remedy for topic in worse)
    assert findings[Topic.PREEMPTION].found == "PREEMPT_DYNAMIC, voluntary"
    assert "preempt=full" in findings[Topic.PREEMPTION].remedy
    assert findings[Topic.GOVERNOR].found == "performance, powersave"
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda _: (0, 0))
    assert by_topic(host_findings(tmp_path))[Topic.PRIORITY].found == "limit 0, the loop asks for 80"
    assert is_ready(host_findings(tmp_path)), "advice is no reason not to run"


def test_a_timer_slack_that_the_loop_may_not_change_is_told(tmp_path, monkeypatch):
    write(tmp_path, proc__self__timerslack_ns="50000")
    before = ctypes.CDLL(None).prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0)
    good = by_topic(host_findings(tmp_path))[Topic.TIMER_SLACK]
    assert (good.verdict, good.found) == (
        Verdict.GOOD,
        "50000 ns for this process; the loop sets 1 ns for itself",
    )
    assert ctypes.CDLL(None).prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0) == before, "looking changes nothing"
    refused = RealTimeSetting(RealTimeFeature.TIMER_SLACK, False, "Operation not permitted")
    monkeypatch.setattr(doctor, "tighten_timers", lambda: refused)
    bad = by_topic(host_findings(tmp_path))[Topic.TIMER_SLACK]
    assert (bad.verdict, bad.found) == (
        Verdict.ADVICE,
        "50000 ns for this process; the loop cannot change it (Operation not permitted)",
    )
    assert "PR_SET_TIMERSLACK" in bad.remedy


def test_whatever_is_not_good_has_a_remedy(tmp_path):
    interface(tmp_path, "can0", flags="0x40080", queue="10")
    for link in ([], [{"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": {"state": "STOPPED"}}}]):
        findings = examine(Wanted("can0", 1_000_000), tmp_path, lambda link=link: link)
        assert [
            finding.topic for finding in findings if finding.verdict is not Verdict.GOOD and not finding.remedy
        ] == []


def test_a_good_can_interface(tmp_path):
    interface(tmp_path, "can0")
    found = can(tmp_path, GOOD_CAN, Wanted("can0", 1_000_000))
    assert {finding.verdict for finding in found.values()} == {Verdict.GOOD}
    assert {topic: finding.found for topic, finding in found.items()} == {
        Topic.INTERFACE: "up, error-active",
        Topic.BIT_RATE: "1000000 bit/s",
        Topic.SAMPLE_POINT: "87.5%",
        Topic.RESTART: "after 100 ms",
        Topic.QUEUE: "100 frames",
        Topic.TIMESTAMPS: "the kernel's: can0 has none",
    }


def test_hardware_stamps_and_a_gateway_that_restarts_its_controller_are_told(tmp_path, monkeypatch):
    interface(tmp_path, "can0")
    write(tmp_path, proc__self__status="Name: x\nCapEff:\t0000000000001000")
    monkeypatch.setattr(doctor, "why_no_hardware_stamps", lambda name: "")
    link = json.loads(json.dumps(GOOD_CAN))
    link["linkinfo"]["info_data"]["restart_ms"] = 0
    found = can(tmp_path, link)
    assert found[Topic.TIMESTAMPS].found == "by the controller's own clock"
    assert (found[Topic.RESTART].verdict, found[Topic.RESTART].found) == (
        Verdict.GOOD,
        "by the gateway itself, which has CAP_NET_ADMIN",
    )


@pytest.mark.parametrize(
    ("change", "topic", "verdict", "found", "remedy"),
    [
        ({"state": "BUS-OFF"}, Topic.INTERFACE, Verdict.PROBLEM, "bus-off", "type can restart"),
        ({"state": "ERROR-PASSIVE"}, Topic.INTERFACE, Verdict.ADVICE, "up, error-passive", "termination"),
        ({"restart_ms": 0}, Topic.RESTART, Verdict.ADVICE, "by hand: the gateway has no CAP_NET_ADMIN to do it",
         "ip link set can0 type can restart-ms 100"),
        ({"restart_ms": 10}, Topic.RESTART, Verdict.ADVICE, "after 10 ms, queued frames then still move drives",
         "ip link set can0 type can restart-ms 100"),
        ({"bittiming": {"bitrate": 500000, "sample_point": "0.875"}}, Topic.BIT_RATE, Verdict.PROBLEM,
         "500000 bit/s, the configuration says 1000000", "type can bitrate 1000000"),
        ({"bittiming": {"bitrate": 0}}, Topic.BIT_RATE, Verdict.PROBLEM, "not set", "bitrate 1000000"),
        ({"bittiming": {"bitrate": 1000000, "sample_point": "0.750"}}, Topic.SAMPLE_POINT, Verdict.ADVICE, "75.0%",
         "sample-point 0.875"),
        ({"bittiming": {"bitrate": 1000000}}, Topic.SAMPLE_POINT, Verdict.ADVICE,
         "unknown: the driver does not tell it", "samples at 87.5 %"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_can_interface(tmp_path, change, topic, verdict, found, remedy):
    interface(tmp_path, "can0")
    link = json.loads(json.dumps(GOOD_CAN))
    link["linkinfo"]["info_data"] |= change
    finding = can(tmp_path, link, Wanted("can0", 1_000_000))[topic]
    assert (finding.verdict, finding.found) == (verdict, found)
    assert remedy in finding.remedy


def test_an_interface_that_is_down_with_a_short_queue_and_no_ip(tmp_path):
    interface(tmp_path, "can0", flags="0x40080", queue="10")
    found = by_topic(can_findings(Wanted(), tmp_path, []), "can0")
    assert found[Topic.INTERFACE].verdict is Verdict.PROBLEM
    assert found[Topic.INTERFACE].remedy == "ip link set can0 up"
    assert found[Topic.QUEUE].remedy == "ip link set can0 txqueuelen 100"
    assert found[Topic.BIT_RATE].remedy == "install iproute2"


def test_a_virtual_interface_needs_no_bit_rate(tmp_path):
    interface(tmp_path, "can0", queue="10", is_virtual=True)
    found = can(tmp_path, {"ifname": "can0", "linkinfo": {"info_kind": "vcan"}})
    assert {finding.verdict for finding in found.values()} == {Verdict.GOOD}
    assert Topic.RESTART not in found


def test_a_channel_that_is_not_there_is_a_problem(tmp_path):
    findings = can_findings(Wanted("can7"), tmp_path, [])
    assert not is_ready(findings)
    assert findings[-1].where == "can7"


def test_an_empty_machine_is_looked_at_without_a_complaint(tmp_path):
    findings = examine(root=tmp_path, links=list)
    document = findings_json(findings)
    assert document["is_ready"]
    assert len(document["findings"]) >= 9
    assert all(set(row) == {"topic", "where", "verdict", "found", "remedy"} for row in document["findings"])


def test_the_command_on_this_machine():
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert done.exit_code in (0, 1)
    assert {row["topic"] for row in json.loads(done.stdout)["findings"]} >= {"SocketCAN", "kernel preemption"}
    shown = CliRunner().invoke(app, ["doctor"])
    assert "isolated processors" in shown.stdout
    refused = CliRunner().invoke(app, ["doctor", "-c", "nosuchcan9"])
    assert refused.exit_code == 1
    assert "nosuchcan9: the configuration's channel is not there" in refused.stderr
