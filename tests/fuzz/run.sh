#!/usr/bin/env bash
# Fuzzes each target for so many seconds (60 without an argument) with libFuzzer on the stable compiler; fails at the first
# crash, whose input is left in tests/fuzz/artifacts. Needs a C++ compiler, for libFuzzer.
set -euo pipefail
cd "$(dirname "$0")"
seconds=${1:-60}
host=$(rustc -vV | sed -n 's/^host: //p')
# What cargo-fuzz asks of a nightly compiler, but for the address sanitizer.
passes=(-Cpasses=sancov-module)
for argument in level=4 inline-8bit-counters pc-table trace-compares; do
    passes+=("-Cllvm-args=-sanitizer-coverage-$argument")
done
export RUSTFLAGS="${passes[*]} --cfg fuzzing"
# Naming the host's own target keeps the counters out of build scripts.
${CARGO:-cargo} build --release --locked --target "$host"
mkdir -p artifacts logs
targets=(kinect1_packets kinect2_packet recordings mcap_recordings relief_files)
# A recording with the descriptions of its messages is longer than other inputs.
declare -A longest=([mcap_recordings]=16384)
fuzz() {
    mkdir -p "corpus/$1"
    "target/$host/release/$1" "corpus/$1" "seeds/$1" -len_control=0 -max_total_time="$seconds" -rss_limit_mb=1024 -timeout=10 \
        -max_len="${longest[$1]:-4096}" -artifact_prefix="artifacts/$1-" -print_final_stats=1 >"logs/$1" 2>&1
}
# All at once: each has one thread.
jobs=()
for target in "${targets[@]}"; do
    fuzz "$target" &
    jobs+=($!)
done
failed=0
for index in "${!targets[@]}"; do
    wait "${jobs[$index]}" || failed=1
    printf '\n== %s for %s s ==\n' "${targets[$index]}" "$seconds"
    grep -v '^#.*\(NEW\|REDUCE\|pulse\)' "logs/${targets[$index]}" | tail -n 40
done
exit "$failed"
