#!/usr/bin/env bash
# Runs every fuzz target and tells what it reached: run.sh BUILD_FOLDER SECONDS [TARGET ...]
#
# Corpora stay in BUILD_FOLDER/corpus, so that a next run goes on from them. An input that fails is
# kept in BUILD_FOLDER/found; it becomes a regression test.
set -euo pipefail
build=$(cd "$1" && pwd)
seconds=$2
shift 2
targets=("$@")
if [ ${#targets[@]} -eq 0 ]; then targets=(container encoder journal learning_map sealed_map); fi
here=$(cd "$(dirname "$0")" && pwd)
profiles=$build/profiles
rm -rf "$profiles" "$build/seeds"
mkdir -p "$profiles" "$build/found" "$build/seeds"
LLVM_PROFILE_FILE=/dev/null "$build/fuzz/seeds" "$build/seeds"

failed=0
objects=()
for target in "${targets[@]}"; do
  corpus=$build/corpus/$target
  mkdir -p "$corpus"
  objects+=(-object "$build/fuzz/fuzz_$target")
  LLVM_PROFILE_FILE=$profiles/$target.profraw "$build/fuzz/fuzz_$target" \
    -max_total_time="$seconds" -max_len=16384 -timeout=10 -rss_limit_mb=2048 -malloc_limit_mb=256 \
    -dict="$here/protomark.dict" -artifact_prefix="$build/found/$target-" -print_final_stats=1 \
    "$corpus" "$build/seeds/$target" > "$build/$target.log" 2>&1 || {
    failed=1
    echo "$target FAILED, the input is in $build/found:"
    grep -E "ERROR|SUMMARY|fuzz_.*:" "$build/$target.log" | head -20
  }
  executions=$(grep -oP 'number_of_executed_units: \K\d+' "$build/$target.log" || echo "?")
  edges=$(grep -oP ' cov: \K\d+' "$build/$target.log" | tail -1)
  echo "$target: $executions inputs, $edges edges, $(find "$corpus" -type f | wc -l) kept"
done

if command -v llvm-profdata > /dev/null && ls "$profiles"/*.profraw > /dev/null 2>&1; then
  llvm-profdata merge -sparse "$profiles"/*.profraw -o "$profiles/all.profdata"
  echo "lines of the readers that these inputs ran:"
  llvm-cov report "${objects[@]:1}" -instr-profile="$profiles/all.profdata" \
    "$here"/../src/file/*.cpp "$here"/../src/encoder/encoder.cpp \
    "$here"/../src/map/{learning_map_file,map_sections,positions,sealed_map}.cpp 2> /dev/null |
    awk '/\.cpp|TOTAL/ { print "  " $1, $10 }'
fi
exit $failed
