from __future__ import annotations

import json
import subprocess
import sys

SETTINGS = {"timer_slack", "sched_fifo", "mlockall", "wake_latency", "cpu_affinity", "gc_freeze"}


def in_a_process_of_its_own(program: str) -> dict[str, str]:
    """Run `program`, which sets `report`, where its settings cannot disturb the other tests."""
    head = "import json\nfrom hiernav.runtime.realtime import RealtimeConfig, request_realtime\n"
    tail = "\nprint(json.dumps(report))"
    done = subprocess.run([sys.executable, "-c", head + program + tail], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_every_setting_is_reported_as_granted_or_with_the_reason_why_not():
    report = in_a_process_of_its_own("report = request_realtime(RealtimeConfig(cpus=(0,)))")
    assert set(report) == SETTINGS
    assert all(text.startswith(("granted", "refused: ")) for text in report.values())
    assert report["gc_freeze"].startswith("granted")


def test_what_is_not_asked_for_is_left_alone():
    report = in_a_process_of_its_own(
        "nothing = RealtimeConfig(0, fifo_priority=None, lock_memory=False, wake_latency_us=None, freeze_gc=False)\n"
        "report = request_realtime(nothing)"
    )
    assert report == dict.fromkeys(SETTINGS, "not asked")


def test_processes_that_are_started_later_are_not_real_time():
    """A planner at the loop's priority would take the processor from it."""
    report = in_a_process_of_its_own(
        "import os\n"
        "asked = []\n"
        "os.sched_setscheduler = lambda pid, policy, param: asked.append((pid, policy))\n"
        "report = request_realtime(RealtimeConfig(timer_slack_ns=0, lock_memory=False, freeze_gc=False))\n"
        "assert asked == [(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK)], asked"
    )
    assert report["sched_fifo"].startswith("granted")


def test_processors_wake_in_time_for_as_long_as_the_process_lives(tmp_path):
    """The kernel forgets the request where its device is closed."""
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    report = in_a_process_of_its_own(
        "import os\n"
        "from hiernav.runtime import realtime\n"
        f"realtime.WAKE_LATENCY = {str(device)!r}\n"
        "report = request_realtime(RealtimeConfig(fifo_priority=None, lock_memory=False, wake_latency_us=20))\n"
        "report['held'] = [os.readlink(f'/proc/self/fd/{fd}') for fd in os.listdir('/proc/self/fd')"
        " if os.path.exists(f'/proc/self/fd/{fd}')]"
    )
    assert report["wake_latency"] == "granted: 20 us" and device.read_bytes() == (20).to_bytes(4, sys.byteorder)
    assert str(device) in report["held"]


def test_a_machine_without_a_say_in_it_wakes_as_it_can(tmp_path):
    report = in_a_process_of_its_own(
        "from hiernav.runtime import realtime\n"
        f"realtime.WAKE_LATENCY = {str(tmp_path / 'none')!r}\n"
        "report = request_realtime(RealtimeConfig(fifo_priority=None, lock_memory=False))"
    )
    assert report["wake_latency"].startswith("refused: [Errno 2] No such file")


def test_the_adapter_comes_before_the_loop_and_beside_it_where_its_user_may_not():
    """At one priority a loop that never lets go of its processor would keep the adapter's watchdog from braking."""
    report = in_a_process_of_its_own(
        "import os\n"
        "asked, most = [], 99\n"
        "def ask(pid, policy, param):\n"
        "    asked.append(param.sched_priority)\n"
        "    if param.sched_priority > most: raise PermissionError(1, 'Operation not permitted')\n"
        "os.sched_setscheduler = ask\n"
        "config = RealtimeConfig(timer_slack_ns=0, fifo_priority=7, lock_memory=False, freeze_gc=False)\n"
        "loop = request_realtime(config)['sched_fifo']\n"
        "adapter = request_realtime(config, before_the_loop=True)['sched_fifo']\n"
        "most = 7\n"
        "report = [loop, adapter, request_realtime(config, before_the_loop=True)['sched_fifo'], asked]"
    )
    assert report[:2] == ["granted: priority 7", "granted: priority 8"]
    assert report[2].startswith("granted: priority 7, no more than the loop") and report[3] == [7, 8, 8, 7]


def test_what_the_system_refuses_is_never_raised():
    report = in_a_process_of_its_own("report = request_realtime(RealtimeConfig(fifo_priority=98, cpus=(100000,)))")
    assert report["sched_fifo"].startswith(("granted", "refused: "))
    assert report["cpu_affinity"].startswith("refused: ")


def test_a_system_without_these_calls_is_no_error():
    report = in_a_process_of_its_own(
        "import ctypes, os\n"
        "def missing(*_, **__): raise OSError('no libc here')\n"
        "ctypes.CDLL = missing\n"
        "del os.sched_setscheduler, os.sched_setaffinity\n"
        "report = request_realtime(RealtimeConfig(cpus=(0,)))"
    )
    assert report["timer_slack"] == "refused: no libc here"
    assert report["sched_fifo"].startswith("refused: ")
    assert report["cpu_affinity"].startswith("refused: ")
