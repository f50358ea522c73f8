#!/usr/bin/env bash
# The native kernels under AddressSanitizer with UndefinedBehaviorSanitizer, then ThreadSanitizer.
set -euo pipefail
cd "$(dirname "$0")"
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
for kinds in address,undefined thread; do
    for program in check check_exchange; do
        "${CXX:-c++}" -std=c++17 -O1 -g -march=native -Wall -Wextra -Werror \
            "-fsanitize=$kinds" -fno-sanitize-recover=all -I../../pgjax/native "$program.cc" \
            -o "$out/$program" -pthread
        said=$("$out/$program")
        echo "$program, $kinds: $said"
    done
done
