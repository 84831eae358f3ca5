"""Runs the package's tests under two kernels of the linear algebra: `make kernels`.

OpenBLAS, MKL and PyTorch have a kernel for each generation of processors and take the best at hand. The kernels sum
in different orders, so the last digits differ, and a bound that is met on one machine by luck fails on another. Here
the processor plays two older ones. Arguments go to pytest.
"""

import json
import os
import subprocess
import sys

# Oldest last: the kernel's name in OpenBLAS, and what PyTorch's own kernels and its MKL may use.
KERNELS = (
    ("Haswell", "avx2", "AVX2"),
    ("Sandybridge", "default", "AVX"),
    ("Nehalem", "default", "SSE4_2"),
    ("NeoverseN1", "default", "AUTO"),
    ("ARMv8", "default", "AUTO"),
)

# Multiplies in NumPy, SciPy and PyTorch, so that a kernel that this processor cannot run fails here and not later.
_PROBE = """
import json
import numpy as np, scipy.linalg, torch
from threadpoolctl import threadpool_info
A = np.random.default_rng(0).standard_normal((64, 64))
np.linalg.svd(A @ A), scipy.linalg.svd(A), torch.linalg.svd(torch.from_numpy(A) @ torch.from_numpy(A))
libraries = [(i["filepath"], i["architecture"]) for i in threadpool_info() if i["internal_api"] == "openblas"]
print(json.dumps({"openblas": libraries, "torch": torch.backends.cpu.get_cpu_capability()}))
"""


def main(arguments):
    if not _found(os.environ)["openblas"]:
        print("Neither NumPy nor SciPy uses OpenBLAS here, and other libraries have no kernels to choose: skipped.")
        return 0
    kernels = [kernel for kernel in KERNELS if _runs(kernel)]
    if len(kernels) < 2:
        print(f"This processor runs fewer than two of the kernels {', '.join(name for name, *_ in KERNELS)}: skipped.")
        return 0
    failed = False
    for kernel in (kernels[0], kernels[-1]):
        environment = _environment(kernel)
        found = _found(environment)
        print(f"\n{kernel[0]}: PyTorch runs {found['torch']}, its MKL at most {kernel[2]}")
        for path, architecture in found["openblas"]:
            print(f"  {architecture}: {os.path.basename(path)}")
        sys.stdout.flush()
        tests = ["tests", "--ignore=tests/test_book.py", "-m", "not realdata"]
        failed |= subprocess.call([sys.executable, "-m", "pytest", "-q", *tests, *arguments], env=environment) != 0
    return int(failed)


def _environment(kernel):
    names = ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY", "MKL_CBWR")
    return {**os.environ, "OPENBLAS_VERBOSE": "0", **dict(zip(names, kernel, strict=True))}


def _found(environment):
    """Which kernels a fresh process uses, or None if it fails."""
    done = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else None


def _runs(kernel):
    found = _found(_environment(kernel))
    return found is not None and {name.lower() for _, name in found["openblas"]} == {kernel[0].lower()}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
