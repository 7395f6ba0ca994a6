"""Commands with junk for options, descriptions and fields: a result, or one message, soon.

The junk is drawn from a seed. What a command raises beyond its own exit fails the test, and so
do warnings.
"""

import json
import resource
import shutil
import time
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from reflfield.field.file import write_field
from reflfield.pipeline.pipeline_options import PipelineOptions
from tests.synthetic_fields import baked_field, lambert, square_surface

SEED = 13
MOST_SECONDS = 10
MOST_BYTES = 2**30
LONGEST_MESSAGE = 2000

WORDS = (
    *("", " ", "0", "-1", "1", "3", "0.5", "1e300", "-1e300", "1e-300", "nan", "inf", "-inf"),
    *("9" * 4000, "0x" + "f" * 6000, "2147483648", "1000000000", "x", "é", "\ud800", "a\nb"),
    *("[]", "[1, 2]", "[[[[]]]]", "{}", "{a = 1}", "true", "1979-05-27", "'x'", "../../x", "/"),
    *("[bold]b[/bold]", "<script>", "\x1b[2J", "%s%n", "a=b=c", ",", "1,0,1", "X", "0,0,0"),
    *("/dev/null", "/dev/zero", "/proc/self/mem", "tcp://127.0.0.1:1", "x" * 5000, "\u202e"),
)
JUNK = (
    *(None, True, False, 0, -1, 1, 0.5, 1e308, -1e308, 1e-320, 10**18, 10**400, 65536, 8.5),
    *("", "nan", "../a.png", "/etc/passwd", "/dev/zero", "a\nb", "\x1b[2J", "\ud800", "CON"),
    *("<script>alert(1)</script>", "[bold]b[/bold]", "x" * 5000, "../../../x", "\u202e", "."),
    *([], {}, [[]], [0, 0, 0], [1e308] * 3, ["1", "2", "3"], {"a": {"b": []}}, [0] * 2000),
)
# Options of commands, but for those that name clusters and stores, which cannot be junk soon.
OF_RUN = (
    *("--set", "--hold-out", "--size", "--psnr", "--from", "--until", "--workers", "--format"),
    *("--max-memory", "--encoding", "--layer", "--config", "--store"),
)
OF_RELIGHT = (
    *("--orbit", "--environment", "--convention", "--environment-up", "--environment-rotation"),
    *(
        "--light",
        "--rays-per-pixel",
        "--size",
        "--elevation",
        "--workers",
        "--max-memory",
        "--capture",
    ),
)


def option_names(options, before=""):
    """Names of all options as ``--set`` takes them."""
    for entry in fields(options):
        value = getattr(options, entry.name)
        if is_dataclass(value):
            yield from option_names(value, f"{before}{entry.name}.")
        else:
            yield before + entry.name


OPTIONS = tuple(option_names(PipelineOptions()))


@pytest.fixture
def answered(reflfield, tmp_path):
    """Function that runs a command and demands a result or one message, soon, in memory."""

    def command(*words):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        started = time.monotonic()
        outcome = reflfield(*words)
        assert time.monotonic() - started < MOST_SECONDS, words
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        assert grown * 1024 < MOST_BYTES, words
        said = [line for line in outcome.err.splitlines() if "rror" in line]
        assert outcome.status in (0, 2, 3), (words, outcome)
        assert (len(said) == 1) == (outcome.status == 2), (words, outcome)
        own = [line for line in said if line.startswith("reflfield")]
        assert all(len(line) < LONGEST_MESSAGE for line in own), words
        assert outcome.err.replace("\n", "").isprintable(), words
        return outcome

    return command


@pytest.fixture
def field_path(tmp_path):
    field = baked_field(square_surface(4), lambert(0.5), view_side=3, light_side=3)
    write_field(tmp_path / "field.rfld", field)
    return tmp_path / "field.rfld"


def drawn(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def places(value, above=()):
    """Paths of all values in a document."""
    if isinstance(value, dict | list):
        inner = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in inner:
            yield (*above, key)
            yield from places(item, (*above, key))


def spoil(rng, document):
    """Put junk in the place of one value, or leave it out."""
    *above, last = drawn(rng, list(places(document)))
    at = document
    for key in above:
        at = at[key]
    if rng.random() < 0.2:
        del at[last]
    else:
        at[last] = drawn(rng, JUNK)


def damage(rng, content):
    """Flip, cut, repeat or blank some bytes."""
    data, at = bytearray(content), int(rng.integers(len(content)))
    kind = int(rng.integers(4))
    if kind == 0:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[at:]
    elif kind == 2:
        data[at:at] = data[: int(rng.integers(len(data)))]
    else:
        data[at : at + 64] = bytes(min(64, len(data) - at))
    return bytes(data)


def fuzz_settings(answered, capture, out, rng, count):
    """Every option with junk; the name of the last stage is wrong, so that nothing is made."""
    for name in OPTIONS:
        for _ in range(count):
            setting = f"{name}={drawn(rng, WORDS)}"
            outcome = answered(
                "run", capture, "-o", out, "--until", "nowhere", "--set", setting
            )
            assert outcome.status == 2, setting
            assert "nowhere" in outcome.err or name.split(".")[-1] in outcome.err, outcome
            assert not out.exists()


def fuzz_words(answered, capture, field, out, rng, count):
    """Options of the commands themselves with junk."""
    run = ("run", capture, "--until", "silhouettes")
    relight = (
        "relight",
        field,
        "--light",
        "1,0,1",
        "--orbit",
        1,
        "--rays-per-pixel",
        1,
        "--size",
        8,
    )
    for command, names in ((run, OF_RUN), (relight, OF_RELIGHT)):
        for name in names:
            for _ in range(count):
                answered(*command, "-o", out, f"{name}={drawn(rng, WORDS)}")
                shutil.rmtree(out, ignore_errors=True)


def fuzz_descriptions(answered, capture, field, out, rng, count):
    """Junk in capture.json, read by all commands."""
    text = (capture / "capture.json").read_text()
    for _ in range(count):
        document = json.loads(text)
        for _ in range(int(rng.integers(1, 3))):
            spoil(rng, document)
        (capture / "capture.json").write_text(json.dumps(document))
        answered("inspect", capture)
        answered("run", capture, "-o", out, "--until", "hull", "--set", "hull.resolution=16")
        answered("relight", field, "--capture", capture, "--rays-per-pixel", 1, "-o", out)
        shutil.rmtree(out, ignore_errors=True)


def fuzz_fields(answered, field, out, rng, count):
    """Damaged field files; what opens gives pictures."""
    content = field.read_bytes()
    for _ in range(count):
        field.write_bytes(damage(rng, content))
        answered("inspect", field)
        answered(
            *("relight", field, "--light", "1,0,1", "--orbit", 1, "--rays-per-pixel", 1),
            *("--size", 8, "-o", out),
        )
        shutil.rmtree(out, ignore_errors=True)


def fuzz_all(answered, capture, field, out, scale):
    """All of them, `scale` times."""
    rng = np.random.default_rng(SEED)
    fuzz_settings(answered, capture, out, rng, scale)
    fuzz_words(answered, capture, field, out, rng, scale)
    fuzz_descriptions(answered, capture, field, out, rng, 6 * scale)
    fuzz_fields(answered, field, out, rng, 12 * scale)


def test_junk_is_a_result_or_one_message(answered, capture_copy, field_path, tmp_path):
    fuzz_all(answered, capture_copy, field_path, tmp_path / "out", 2)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_much_junk(answered, capture_copy, field_path, tmp_path):
    fuzz_all(answered, capture_copy, field_path, tmp_path / "out", 30)
