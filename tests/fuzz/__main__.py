"""Run the fuzzer: `python -m tests.fuzz --seconds 60`, or `make fuzz SECONDS=60`.

Prints each new finding with the file that holds a small case of it, and in the end how many cases
were tried and with which --start the next run goes on. Exit code 1 if something was found.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from .cases import KINDS, case_of
from .driver import Session
from .worker import Worker


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="for all kinds together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=int, default=0, help="the number of the first case")
    parser.add_argument("--case", type=int, help="try this number only, and print all findings")
    parser.add_argument("--kind", choices=KINDS, help="both, one after the other, by default")
    parser.add_argument("--device", default="cpu", help="as voxtool's --device")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=float, default=20, help="processor seconds of a case")
    parser.add_argument("--folder", type=Path, default=Path("build/fuzz"))
    return parser.parse_args()


def replay(session: Session, kind: str, number: int) -> int:
    """Try one case and print it."""
    case = case_of(kind, session.seed, number, session.contents)
    print(repr(case)[:2000])
    worker = Worker(session.folder, session.device, session.limit)
    findings = worker.ask(case)
    worker.stop()
    for finding in findings:
        print(f"{finding.key}: {finding.detail}")
    return bool(findings)


def main() -> int:
    given = options()
    session = Session(given.folder, given.seed, given.device, given.workers, given.limit)
    kinds = [given.kind] if given.kind else KINDS
    if given.case is not None:
        return max(replay(session, kind, given.case) for kind in kinds)
    for kind in kinds:
        began = time.monotonic()
        end = session.run(kind, given.start, given.seconds / len(kinds))
        count, seconds = end - given.start, time.monotonic() - began
        print(
            f"{kind}: cases {given.start} to {end - 1} of seed {given.seed}, "
            f"{count / seconds:.1f} a second; go on with --start {end}"
        )
    for found in session.found.values():
        print(f"{found.count:6}  {found.finding.key}")
    return bool(session.found)


if __name__ == "__main__":
    sys.exit(main())
