#!/bin/sh
# Evaluate the policy in gallop.py from the command line, and keep the worst two of its
# six episodes on video: where it is weak, and no more files than that.
set -eu
out=${1:-recordings/gallop}
mkdir -p "$out"
out=$(cd "$out" && pwd)

# The policy is looked for in the working directory.
cd "$(dirname "$0")"
mjrec record HalfCheetah-v5 --policy gallop:Gallop --out "$out" --force \
  --episodes 6 --max-steps 60 --seed 0 --keep worst:2 --annotate --size 240x180
mjrec list "$out"
