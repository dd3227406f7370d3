#!/usr/bin/env python3
"""Drive a robot with an exported bundle at a fixed rate, without torch.

The robot is a simulated one with noisy sensors, or yours (--adapter); the policies see the estimate alone. In real time
the planner and the robot's adapter live in processes of their own. Every drive in simulation leaves a picture, the run
a summary on screen and as JSON. Ctrl-C, SIGTERM and SIGHUP brake the robot, have it verified that it stands, and still
write the summary.

  run_loop.py --episodes 10                       ten simulated worlds
  run_loop.py --serve                             be ready for goals, until Ctrl-C
  run_loop.py --tell "goal 1.2,-0.5"              command the loop that runs: goal X,Y, cancel, pause, resume, stop,
                                                  acknowledge, status, quit
  run_loop.py --view                              drive in a simulated world, and watch and click in the browser
  run_loop.py --dry-run                           check bundle, robot and host; nothing moves

Settings (--set guard.slow_ttc=0.5, or a YAML file with sections) are those of driver, estimator, guard, realtime and
noise.
Exit codes: 0 done or interrupted; 1 a fault (with --serve and --view one that nobody has acknowledged); 2 bad input;
3 a bundle that must not be used; 4 a goal that cannot be driven to.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hiernav.drive import main as run
from hiernav.runtime.loop import stop_signals
from hiernav.runtime.patient import PatientWriter, be_patient, hurry


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    return run.main(argv, __doc__ or "", Path(__file__).resolve().parent)


if __name__ == "__main__":
    be_patient()
    status = main()
    for number in stop_signals():  # all that was to be done is done
        signal.signal(number, lambda *_: hurry())
    with suppress(OSError):
        if sys.stdout is not None:
            sys.stdout.flush()
        if PatientWriter.lost:
            why = f": {PatientWriter.why}" if PatientWriter.why else ""
            print(f"run_loop: not all of the output was taken{why}", file=sys.stderr, flush=True)
    for number in stop_signals():
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)
