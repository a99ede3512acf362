#!/bin/sh
# Instructions of the kernels of tracking, fusion and refinement: what a busy machine cannot blur.
#
#     tests/bench/instructions.sh [PROGRAM [SESSION]]       (needs valgrind)
#
# Printed: millions of instructions a depth frame, for the mesh in all, and for one refinement in all, on one thread. Valgrind has no AVX-512, so that
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

for kernel in 'carry_on::*::on_the_way' icp::align sdf_alignment::align integrate::integrate raycast::raycast; do
    count "$kernel" | awk -v kernel="$kernel" -v frames="$frames" \
        '{ printf "%-32s %8.2f million a frame\n", kernel, $1 / frames / 1e6 }'
done
count marching_cubes::marching_cubes | awk '{ printf "%-32s %8.2f million\n", "marching_cubes::marching_cubes", $1 / 1e6 }'

# Of a refinement all kernels are counted in one run.
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$program" replay "$session" --out "$folder/scan" >/dev/null 2>&1
valgrind --tool=callgrind "--callgrind-out-file=$folder/counts" "$program" refine "$folder/scan" --out "$folder/refined" --threads 1 >/dev/null 2>&1
callgrind_annotate --inclusive=yes --auto=no "$folder/counts" >"$folder/functions"
for kernel in refine::refine geometry::rasterise::rasterise refine::sites::Sites::seen_by refine::observations::Observations::every \
    refine::rendering::render refine::alignment::align_view refine::energy::Problem::linearise refine::cholesky::Analysis::factorise; do
    # A function has a line for each file that is inlined into it; the first has the most.
    awk -v kernel=":relief::$kernel" '
        { at = index($0, kernel); rest = substr($0, at + length(kernel)) }
        at && (rest == "" || rest ~ /^ \[/) { gsub(",", "", $1); printf "%-42s %9.0f million\n", substr(kernel, 10), $1 / 1e6; exit }' \
        "$folder/functions"
done
