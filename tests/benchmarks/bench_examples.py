"""What the examples print, where it is figures: how far normals of `align_samples.py` are off.

    python tests/benchmarks/bench_examples.py [--texels 400] [--unobserved 0 0.3 0.6]

The other examples make images. Writes results/examples.json; status 1 where the normals are not
ten times nearer to the truth than without alignment.
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from benchmarks.measuring import ROOT, Results  # noqa: E402

MODULES = ("reflfield.alignment.align_texels", "reflfield.factorization.svd_completion")
PRINTED = re.compile(r"off by ([\d.]+) degrees on average; unaligned ([\d.]+)")


def align_samples(texels, unobserved):
    """Mean errors of the normals, degrees: with alignment and without."""
    script = ROOT / "examples" / "align_samples.py"
    words = ("--texels", str(texels), "--unobserved", str(unobserved))
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, text=True, check=True
    )
    return tuple(map(float, PRINTED.search(done.stdout).groups()))


def main():
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--texels", type=int, default=400)
    parser.add_argument("--unobserved", type=float, nargs="+", default=[0.0, 0.3, 0.6])
    arguments = parser.parse_args()
    results, missed = Results("examples", "Examples", MODULES), False
    results.table(f"align_samples.py, {arguments.texels} texels")
    for share in arguments.unobserved:
        error, unaligned = align_samples(arguments.texels, share)
        row = {"not measured": share, "normals off, degrees": error, "unaligned": unaligned}
        print(row, flush=True)
        results.add(row)
        missed |= error > 0.1 * unaligned
    print(results.write())
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
