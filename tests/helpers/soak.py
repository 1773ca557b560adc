"""Hours of machine time with random faults, orders and deaths of the gateway, in virtual time.

    python tests/helpers/soak.py --hours 24 --processes 2 --json soak.json
    python tests/helpers/soak.py --seed 17        one campaign alone, every session told

Every seed is a campaign: a machine with masses, friction, noise, cam, speed and control of its own, and the sessions it
goes through one after the other, each from where the last one left it. What is beyond its bound is told with the
command that repeats it. Ctrl-C ends after the campaigns that are under way, and tells what has been done.
"""

import argparse
import json
import multiprocessing
import os
import signal
import sys
import time
import traceback
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from soak_account import LeakWatch, Tally, as_json, table
from soak_judge import Judge
from soak_scenario import draw_campaign, gateway_texts
from soak_session import Rig, Session, proved_law

NOTE_S = 60.0
WARM_UP = 6
"""Campaigns before the first count of what is left behind: until then caches fill."""


def run_campaign(seed: int, tally: Tally, is_telling: bool = False) -> None:
    """One machine and all of its sessions; whatever is wrong is in the tally."""
    number = 0
    try:
        campaign = draw_campaign(seed)
        rig = Rig(campaign)
        for number, plan in enumerate(campaign.sessions):
            session = rig.run(plan)
            judge = Judge(rig, session)
            found = judge.judge()
            tally.take(seed, session, judge)
            rig.settle(session, is_reference_doubtful=bool(judge.unheld))
            # A linkage that nobody could hold may stand where no run can begin.
            rig.is_ready = judge.leaves_a_start
            found += judge.judge_truth()
            if is_telling or found:
                tell = f"session {number}: {session.core.stopped_by.value}, {session.core.failure}; {told(session)}"
                if is_telling:
                    print(tell, judge.figures, sep="\n    ", file=sys.stderr)
            tally.violations += [f"{one} [{tell}] -- {command(seed)}" for one in found]
            if session.is_torn:
                # A torn linkage is not mended by hand.
                break
    except Exception:
        tally.violations.append(f"exception in session {number} -- {command(seed)}\n{traceback.format_exc()}")
    tally.campaigns += 1


def told(session: Session) -> str:
    """What happened in a session."""
    texts = [
        f"{provocation} in {moment.value} at {(at_ns - session.started_ns) * 1e-9:.4f} s"
        for provocation, moment, at_ns in session.fired
    ]
    return ", ".join(texts) or "nothing"


def command(seed: int) -> str:
    """How to repeat a campaign alone."""
    return f"python tests/helpers/soak.py --seed {seed}"


def soak(hours: float, first_seed: int, stride: int, say: Any = None, is_stopping: Any = lambda: False) -> Tally:
    """Campaigns one after the other until so many hours under guard are reached and it can be told whether anything
    was left behind; ``say(tally)`` about once a minute."""
    tally, leaks, seed = Tally(), LeakWatch(), first_seed
    if hours >= 1.0:
        # So that what is kept for good is there before anything is counted.
        for text in gateway_texts():
            proved_law(text)
    noted_s, since_s = time.monotonic(), time.process_time()
    while (tally.guarded_s < hours * 3600.0 or not leaks.is_telling) and not is_stopping():
        run_campaign(seed, tally)
        seed += stride
        tally.processor_s = time.process_time() - since_s
        is_due = time.monotonic() - noted_s > NOTE_S or hours < 1.0
        if tally.campaigns >= WARM_UP and is_due:
            leaks.note()
            tally.grown, tally.rss_kib = leaks.growth(), leaks.rss_kib
        if is_due and say is not None:
            noted_s = time.monotonic()
            say(tally)
    return tally


def _work(hours: float, first_seed: int, stride: int, pipe: Connection, nice: int) -> None:
    stopping: list[bool] = []
    signal.signal(signal.SIGINT, lambda *_: stopping.append(True))
    os.nice(nice)
    pipe.send(soak(hours, first_seed, stride, pipe.send, lambda: bool(stopping)))
    pipe.close()


def run_processes(hours: float, processes: int, first_seed: int, nice: int, log: Any) -> Tally:
    """Share the hours among processes, and put their accounts together."""
    context = multiprocessing.get_context("spawn")
    latest: dict[Any, Tally] = {}
    workers = []
    for number in range(processes):
        ours, theirs = context.Pipe(duplex=False)
        worker = context.Process(
            target=_work, args=(hours / processes, first_seed + number, processes, theirs, nice), daemon=False
        )
        worker.start()
        theirs.close()
        workers.append(worker)
        latest[ours] = Tally()
    print(f"processes {' '.join(str(worker.pid) for worker in workers)}", file=sys.stderr, flush=True)
    signal.signal(signal.SIGINT, lambda *_: print("ending after this campaign", file=sys.stderr))
    open_pipes = list(latest)
    while open_pipes:
        for pipe in wait(open_pipes, timeout=1.0):
            try:
                latest[pipe] = pipe.recv()  # type: ignore[union-attr]
            except EOFError:
                open_pipes.remove(pipe)  # type: ignore[arg-type]
                continue
            log(_merged(latest))
    for worker in workers:
        worker.join()
    return _merged(latest)


def _merged(tallies: dict[Any, Tally]) -> Tally:
    whole = Tally()
    for tally in tallies.values():
        whole.merge(tally)
    return whole


def progress(tally: Tally) -> str:
    """One line."""
    return (
        f"{time.strftime('%H:%M:%S')} {tally.guarded_s / 3600.0:.3f} machine hours under guard ("
        f"{tally.motion_s / 3600.0:.3f} in motion), {tally.campaigns} campaigns, {tally.sessions} sessions, "
        f"{tally.guarded_s / max(tally.processor_s, 1e-9):.1f} x, {len(tally.violations)} beyond bounds, "
        f"memory {tally.rss_kib[1] - tally.rss_kib[0]:+d} KiB"
    )


def main() -> int:
    """The command; 0 where everything was within its bounds, 1 where not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="machine hours under guard (default 24)")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seed", type=int, help="this campaign alone")
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the account here")
    arguments = parser.parse_args()
    if arguments.seed is not None:
        tally = Tally()
        run_campaign(arguments.seed, tally, is_telling=True)
    else:
        said: set[str] = set()

        def log(tally: Tally) -> None:
            print(progress(tally), file=sys.stderr, flush=True)
            for violation in tally.violations:
                if violation not in said:
                    print("  " + violation, file=sys.stderr, flush=True)
            said.update(tally.violations)
            if arguments.json is not None:
                arguments.json.write_text(json.dumps(as_json(tally), indent=1) + "\n", encoding="utf-8")

        tally = run_processes(arguments.hours, arguments.processes, arguments.first_seed, arguments.nice, log)
        log(tally)
    print(table(tally))
    for violation in tally.violations:
        print(violation)
    for name, count in tally.grown.items():
        print(f"left behind: {count} {name}")
    return 1 if tally.violations or tally.grown else 0


if __name__ == "__main__":
    sys.exit(main())
