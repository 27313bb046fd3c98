#!/bin/sh
# Evaluate the policy in gallop.py from the command line. Only the worst two of its six
# episodes get videos, which show the policy's weaknesses with few files.
set -eu
out=${1:-recordings/gallop}
mkdir -p "$out"
out=$(cd "$out" && pwd)

# mjrec looks for the policy in the working directory.
cd "$(dirname "$0")"
mjrec record HalfCheetah-v5 --policy gallop:Gallop --out "$out" --force \
  --episodes 6 --max-steps 60 --seed 0 --keep worst:2 --annotate --size 240x180
mjrec list "$out"
