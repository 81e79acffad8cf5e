#!/usr/bin/env bash
# Dr.Jit 1.5.0 (llvm): whether a subnormal result becomes 0 depends on where the kernel runs.
#
# Worker threads flush subnormal numbers to zero; the thread that calls dr.eval() does not.  It runs small arrays
# itself, and all arrays with one thread.  So the same product of the same two numbers is 9.99995e-41 in an array of
# 16 entries and 0 in one of 100,000, and bits depend on the number of threads wherever a float32 underflows.
#
# Seen, with 2 threads and then with 1:
#   2 threads, 16 entries: 9.99994610111476e-41
#   2 threads, 100000 entries: 0.0
#   1 threads, 16 entries: 9.99994610111476e-41
#   1 threads, 100000 entries: 9.99994610111476e-41
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet drjit==1.5.0 numpy karellen-llvm-core
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ]; then
    DRJIT_LIBLLVM_PATH=$(find "$folder/venv/lib" "$folder/venv/lib64" -name "libLLVM.so.*" 2>/dev/null | head -n 1)
    export DRJIT_LIBLLVM_PATH
fi
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import drjit as dr
from drjit.llvm import Float

found = {}
for threads in (2, 1):
    dr.set_thread_count(threads)
    for n in (16, 100_000):
        x, y = dr.full(Float, 1e-30, n), dr.full(Float, 1e-10, n)
        dr.make_opaque(x, y)
        product = x * y
        dr.eval(product)
        values = set(product.numpy().tolist())
        found[threads, n] = values
        print(f"{threads} threads, {n} entries: {', '.join(map(str, values))}")
flushed = {key for key, values in found.items() if values == {0.0}}
sys.exit(0 if flushed == {(2, 100_000)} else 1)
PYTHON
