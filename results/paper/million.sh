#!/bin/sh
# One task for 1,000,000 steps on a GPU, ten runs: sh results/paper/million.sh Walker2d-v4 [SECONDS [OPTIONS]]
# CSAC and SAC with the paper's settings, five seeds of each in one program. It stops after SECONDS (540) with everything
# saved: run it again until it says "all runs are finished". Each finished run is in results/paper/ then.
set -eu
task=$1 seconds=${2:-540}
shift $(($# < 2 ? $# : 2))
end=$(($(date +%s) + seconds))
for algorithm in csac sac; do
  directory=runs/million/$task/$algorithm
  left=$((end - $(date +%s)))
  [ "$left" -gt 0 ] || exit 0
  if [ -d "$directory" ]; then
    timeout -s INT "$left" csac resume "$directory" || [ $? -eq 124 ] || exit 1
  else
    timeout -s INT "$left" csac train "$task" --algorithm $algorithm --preset paper --first-seed 400 --seeds 5 \
      --seeds-per-process 5 --steps 1000000 --device gpu --directory "$directory" "$@" || [ $? -eq 124 ] || exit 1
  fi
  python results/collect.py "$directory" results/paper --arm "$(echo $algorithm | tr a-z A-Z) (paper), 1M"
done
echo "all runs are finished"
