#!/bin/sh
# Instructions of the kernels of tracking and fusion: what a busy machine cannot blur.
#
#     tests/bench/instructions.sh [PROGRAM [SESSION]]       (needs valgrind)
#
# Printed: millions of instructions a depth frame, and for the mesh in all, on one thread. Valgrind has no AVX-512, so that
# the AVX2 kernels are counted on every processor that has them.
set -eu
program=${1:-target/release/relief}
session=${2:-tests/data/demo}
frames=$(grep -vc '^#' "$session/depth.txt")

# Instructions within one function and all that it calls.
count() {
    valgrind --tool=callgrind --callgrind-out-file=/dev/null "--toggle-collect=relief::fusion::$1" \
        "$program" bench "$session" --threads 1 2>&1 >/dev/null | awk '/Collected/ { print $4 }'
}

for kernel in icp::align sdf_alignment::align integrate::integrate raycast::raycast; do
    count "$kernel" | awk -v kernel="$kernel" -v frames="$frames" \
        '{ printf "%-32s %8.2f million a frame\n", kernel, $1 / frames / 1e6 }'
done
count marching_cubes::marching_cubes | awk '{ printf "%-32s %8.2f million\n", "marching_cubes::marching_cubes", $1 / 1e6 }'
