#!/bin/sh
# One task for 1,000,000 steps on a GPU, ten runs: sh results/paper/million.sh Walker2d-v4 [SECONDS [OPTIONS]]
# CSAC and SAC with the paper's settings, five seeds of each in one program, side by side. It stops after SECONDS (540) with
# everything saved: run it again until it says "all runs are finished". The runs are in results/paper/ then.
set -eu
task=$1 seconds=${2:-540}
shift $(($# < 2 ? $# : 2))

train() {
  directory=runs/million/$task/$1
  if [ -d "$directory" ]; then
    timeout -s INT "$seconds" csac resume "$directory"
  else
    timeout -s INT "$seconds" csac train "$task" --preset paper --first-seed 400 --seeds 5 --seeds-per-process 5 \
      --steps 1000000 --device gpu --directory "$directory" --algorithm "$@"
  fi
}

train csac "$@" & first=$! left=0
train sac "$@" || left=$?
wait $first || left=$?
[ $left -ne 124 ] || exit 0
[ $left -eq 0 ] || exit $left
for algorithm in csac sac; do
  python results/collect.py runs/million/"$task"/$algorithm results/paper --arm "$(echo $algorithm | tr a-z A-Z) (paper), 1M"
done
echo "all runs are finished"
