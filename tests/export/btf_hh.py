"""Samples of a ``.btf`` container by btf.hh, a reader in C++ that is not this project's.

btf.hh is Zdravko Velinov's and is not shipped here. ``BTF_HH`` names it, as
``btf_extractor/c_ext/btf.hh`` of the source package btf-extractor; it is compiled with g++.
"""

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Unless NDEBUG is set, it stops where the data contain the cosine.
_FLAGS = ["-std=c++17", "-O1", "-mavx2", "-mf16c", "-DNDEBUG", "-w"]
_READER = r"""
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#define BTF_IMPLEMENTATION
#include "btf.hh"
int main(int count, char **words) {
  BTFExtra extra;
  BTF *btf = LoadBTF(words[1], &extra);
  if (!btf) return 1;
  uint32_t about[] = {btf->Width, btf->Height, btf->LightCount, btf->ConsineFlag};
  fwrite(about, 4, 4, stdout);
  fwrite(btf->Lights, 12, btf->LightCount, stdout);
  fwrite(extra.Rotations.data(), 36, extra.Rotations.size(), stdout);
  for (int i = 2; i + 1 < count; i += 2)
    for (uint32_t y = 0; y < btf->Height; ++y)
      for (uint32_t x = 0; x < btf->Width; ++x) {
        Spectrum s = BTFFetchSpectrum(btf, atoi(words[i + 1]), atoi(words[i]), x, y);
        fwrite(&s, 12, 1, stdout);
      }
}
"""


@dataclass(frozen=True)
class ReadBtf:
    """What btf.hh says of a container: y = 0 is the bottom of its images, here the top.

    Parameters
    ----------
    cosine_included : bool
    lights : (n, 3) float32
        Directions in the frame of a texel; those of views are the same.
    rotations : (height, width, 3, 3) float32
        Rows tangent, binormal and normal.
    images : (n, height, width, 3) float32
        Of the pairs that were asked for.
    """

    cosine_included: bool
    lights: np.ndarray
    rotations: np.ndarray
    images: np.ndarray


def missing():
    """What is missing to read containers by btf.hh, or None."""
    if not os.environ.get("BTF_HH"):
        return "needs btf.hh (set BTF_HH to it; source package btf-extractor)"
    return None if shutil.which("g++") else "needs g++"


def read_by_btf_hh(path, work, pairs):
    """Contents of a container, and images for pairs of views and lights.

    Parameters
    ----------
    path : Path
    work : Path
        A folder for the program.
    pairs : (n, 2) array_like
        Numbers of views and lights.
    """
    program, source = work / "read_btf", work / "read_btf.cc"
    source.write_text(_READER)
    folder = Path(os.environ["BTF_HH"]).resolve().parent
    subprocess.run(["g++", *_FLAGS, "-I", folder, source, "-o", program], check=True)
    words = [str(int(number)) for number in np.ravel(pairs)]
    read = subprocess.run([program, path, *words], check=True, stdout=subprocess.PIPE).stdout
    width, height, n_lights, cosine = np.frombuffer(read, "<u4", 4)
    numbers = np.frombuffer(read, "<f4", offset=16)
    lights, numbers = np.split(numbers, [3 * n_lights])
    rotations, values = np.split(numbers, [9 * width * height])
    images = values.reshape(len(pairs), height, width, 3)[:, ::-1]
    return ReadBtf(
        bool(cosine), lights.reshape(-1, 3), rotations.reshape(height, width, 3, 3), images
    )
