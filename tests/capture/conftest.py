"""Fixtures of the tests of captures."""

import os
import subprocess
import sys

import pytest


@pytest.fixture
def run_python():
    """Run code in a process of its own with further environment variables; its output."""

    def run(code, environment=None):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **(environment or {})},
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        assert done.stderr == ""
        return done.stdout

    return run
