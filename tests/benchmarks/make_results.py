"""RESULTS.md, its pictures and the README's table of results, from the figures in results/.

    python tests/benchmarks/make_results.py            # write both
    python tests/benchmarks/make_results.py --check    # status 1 if they are something else

Every figure comes from a file that a benchmark or example has written. A file says what code
it measured, by a digest of the modules and of all that they import; where that code has changed
since, the figures are marked. Marks are those of the day on which this ran: they do not count
as a difference, so that a change of code need not touch the pages.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.error_against_time import pictures  # noqa: E402
from benchmarks.measuring import KEYS, RESULTS, ROOT  # noqa: E402

PAGE, README, PICTURES = HERE / "RESULTS.md", ROOT / "README.md", HERE / "pictures"
HEAD = """# Results

Written by `python tests/benchmarks/make_results.py` from `results/*.json`; do not edit. Each
section names the command that measured it, the day, the commit (a + where the tree differed
from it), the machine and its load, which is the number of cores that the command used where
nothing else ran.
"""
MARK = "> Older than the code: "
BEGIN, END = "<!-- results -->", "<!-- /results -->"
# Load over cores above which wall times are not the command's own.
MOST_LOAD = 2.0
PACKAGES = ("python", "numpy", "scipy", "numba")


def main():
    """Write or check."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    wanted, different = pages(load_results()), []
    for path, text in wanted.items():
        if options.check and path.parent == PICTURES:
            continue  # another version of the library draws other bytes
        now = path.read_text(encoding="utf-8") if path.is_file() else ""
        if without_marks(now) != without_marks(text):
            different.append(path.relative_to(ROOT))
        if not options.check:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    for line in marks(wanted[PAGE]):
        print(line)
    if options.check and different:
        sys.exit(f"not what make_results.py writes: {', '.join(map(str, different))}")


def pages(results):
    """Text of both pages, and of the pictures of the first, by path."""
    drawn = pictures(results)
    return {
        PAGE: page(results, drawn),
        README: with_table(README.read_text(encoding="utf-8"), readme_table(results)),
        **{PICTURES / name: text for name, text in drawn.items()},
    }


def load_results(folder=RESULTS):
    """Contents of all files of results, captures first, by name.

    Raises
    ------
    ValueError
        If a file lacks something that `measuring.Results` writes; the message names it.
    """
    results = []
    for path in sorted(folder.glob("*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        missing = [key for key in KEYS if key not in content]
        if missing:
            raise ValueError(f"{path}: expected {', '.join(missing)}; measure it again")
        results.append(content)
    return sorted(results, key=lambda one: (not is_capture(one), one["name"]))


def is_capture(result):
    """Whether `bench_captures.py` has written it."""
    return result["name"].startswith("capture_")


# --- what is older than its code --------------------------------------------------------------


def changed_since(result):
    """Modules whose code, or what it imports, is not what was measured."""
    # Imported here: the pipeline's packages take long, and only digests are wanted of them.
    from reflfield.pipeline.code_digests import code_digest

    return [name for name, digest in result["code"].items() if code_digest(name) != digest]


def mark(result):
    """Line that marks figures older than their code, or nothing."""
    there, here = result["versions"].get("python", ""), platform.python_version()
    if there.split(".")[:2] != here.split(".")[:2]:
        # Digests are of compiled code, which every minor version compiles in its own way.
        return [f"{MARK}not known: measured with Python {there}, compared with {here}."]
    changed = ", ".join(f"`{name}`" for name in changed_since(result))
    return [f"{MARK}{changed}, or what it imports, has changed since."] if changed else []


def marks(text):
    """The marks in a page, each below the heading that it belongs to."""
    heading, notes = "", []
    for line in text.splitlines():
        heading = line.removeprefix("## ") if line.startswith("## ") else heading
        if line.startswith(MARK):
            notes.append(f"{heading}: {line.removeprefix('> ')}")
    return notes


def without_marks(text):
    """A page as it would be if nothing were older than its code."""
    return re.sub(rf"\n{re.escape(MARK)}.*\n", "", text)


# --- RESULTS.md -------------------------------------------------------------------------------


def page(results, drawn=()):
    """The whole page; `drawn` has the names of its pictures."""
    return "\n".join([HEAD, *(section(result, drawn) for result in results)])


def section(result, drawn=()):
    """One heading, with what was measured where, the picture and the tables."""
    machine, versions = result["machine"], result["versions"]
    said = ", ".join(f"{name} {versions[name]}" for name in PACKAGES if name in versions)
    lines = [
        f"## {result['title']}\n",
        f"`{result['command']}`\n",
        f"{result['date']}, commit {result['commit'] or 'unknown'}; {machine['processor']}, "
        f"{machine['cores']} cores, {machine['memory_gb']} GB, load "
        f"{machine.get('load', 'unknown')}; {said}.\n",
        *(f"{line}\n" for line in mark(result)),
    ]
    if (picture := f"{result['name']}.svg") in drawn:
        lines.append(f"![Error against time]({PICTURES.name}/{picture})\n")
    for table in result["tables"]:
        title = [f"{table['title']}:\n"] if table["title"] else []
        lines += [*title, markdown(table["rows"])]
    return "\n".join(lines)


def markdown(rows):
    """Rows as a table; columns in the order in which they first come."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [columns, ["---"] * len(columns)]
    lines += [[cell(row.get(name)) for name in columns] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def cell(value):
    """A value as text: four digits of a fraction."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    return str(value).replace("|", "\\|")


# --- README -----------------------------------------------------------------------------------


def readme_table(results):
    """The captures in short, one line for each set of images, and what is older."""
    rows = [row for result in results if is_capture(result) for row in short_rows(result)]
    captures = [result for result in results if is_capture(result)]
    old = [result["title"].removeprefix("Capture: ") for result in captures if mark(result)]
    marked = [f"{MARK}{', '.join(old)}.\n"] if old else []
    return "\n".join([markdown(rows), *marked]) if rows else "Nothing was measured yet.\n"


def short_rows(result):
    """Rows of one capture; what belongs to the run stands in the first."""
    tables = {table["title"]: table["rows"] for table in result["tables"]}
    (run,) = tables["Run"]
    without = {
        row["images"]: row for row in tables["Images"] if row["field"] == "without alignment"
    }
    rows = []
    for row in tables["Images"]:
        if row["field"] != "aligned":
            continue
        base = without.get(row["images"], {}).get("PSNR, dB")
        first = not rows
        rows.append(
            {
                "capture": result["title"].removeprefix("Capture: ") if first else "",
                "views x lights": run["photographs"] if first else "",
                "images": row["images"].partition(":")[0],
                "PSNR, dB": f"{row['PSNR, dB']:.1f}",
                "not aligned": "-" if base is None else f"{base:.1f}",
                "SSIM": f"{row['SSIM']:.3f}",
                "FLIP": f"{row['FLIP']:.3f}",
                "field": f"{run['field, kB']:.0f} kB" if first else "",
                "time": wall_time(result, run) if first else "",
                "CPU": f"{run['CPU time, s']:.0f} s" if first else "",
                "memory": f"{run['peak memory, GB']:.1f} GB" if first else "",
            }
        )
    return rows


def wall_time(result, run):
    """Wall time of the run, or a dash where the machine had other work at the same time."""
    machine = result["machine"]
    busy = machine.get("load", float("inf")) > MOST_LOAD * machine["cores"]
    return "-" if busy else f"{run['wall time, s']:.0f} s"


def with_table(text, table):
    """A page with the table between its two comments.

    Raises
    ------
    ValueError
        If the comments are not there, once each and in this order.
    """
    before, begin, rest = text.partition(f"{BEGIN}\n")
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in after:
        raise ValueError(f"README: expected one {BEGIN} before one {END}")
    return f"{before}{begin}{table}{end}{after}"


if __name__ == "__main__":
    main()
