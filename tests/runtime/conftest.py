"""What holds for all tests of the runtime; lets those in folders below import the helpers here."""

from __future__ import annotations

import signal

import pytest


@pytest.fixture(autouse=True)
def hangups_are_obeyed():
    """Also where the tests run under nohup, which what they start would inherit."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
