"""Signals before there is work, and processes whose parent is killed."""

import contextlib
import signal
import subprocess
import sys

import psutil
import pytest

from reflfield.util.child_processes import tied
from tests.conftest import until

# Heeds signals whatever the tests are run by; waits, while importing, for the first.
COMMAND = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_DFL)
from reflfield.__main__ import main

class Slow:
    name = sys.argv.pop(1)

    def find_spec(self, name, path=None, target=None):
        if name == self.name:
            print("importing", flush=True)
            time.sleep(30)

sys.meta_path.insert(0, Slow())
main()
"""


@pytest.mark.parametrize("module", ["typer", "reflfield.pipeline.stages", "scipy.spatial"])
@pytest.mark.parametrize(
    ("number", "status", "word"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_a_signal_while_libraries_are_imported(tmp_path, module, number, status, word):
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, module, "run", "nowhere", "-o", str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "importing\n"
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (status, "", f"reflfield: {word}\n")
    assert not (tmp_path / "out").exists()


# Starts a child that sleeps, says which, and waits for it.
PARENT = """
import subprocess, sys
from reflfield.util.child_processes import tied
child = subprocess.Popen(tied([sys.executable, "-c", "import time; time.sleep(60)"]))
print(child.pid, flush=True)
child.wait()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs prctl")
def test_a_child_is_killed_with_its_parent():
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    child = psutil.Process(int(parent.stdout.readline()))
    assert child.is_running()
    parent.kill()
    parent.communicate()
    with contextlib.suppress(psutil.NoSuchProcess):
        child.wait(timeout=10)
    assert not child.is_running()


# Simulates with a program that notes its process and sleeps.
DEMO = """
import sys
from pathlib import Path
import reflfield.demo as demo

demo.simulator = lambda: sys.argv[1]
demo.simulate(Path(sys.argv[2]), 1)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs prctl")
def test_the_simulator_is_killed_with_the_demo(tmp_path):
    noted, program = tmp_path / "process", tmp_path / "capture-sim"
    program.write_text(f"#!/bin/sh\necho $$ > {noted}.new\nmv {noted}.new {noted}\nsleep 60\n")
    program.chmod(0o755)
    demo = subprocess.Popen(
        [sys.executable, "-c", DEMO, program, tmp_path / "demo" / "capture"]
    )
    until(noted.is_file)
    simulator = psutil.Process(int(noted.read_text()))
    demo.kill()
    demo.wait()
    with contextlib.suppress(psutil.NoSuchProcess):
        simulator.wait(timeout=10)
    assert not simulator.is_running()


def test_a_tied_command_is_the_same_command():
    words = [sys.executable, "-c", "import sys; print(sys.argv[1:]); sys.exit(3)", "a b", ""]
    done = subprocess.run(tied(words), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (3, "['a b', '']\n")
