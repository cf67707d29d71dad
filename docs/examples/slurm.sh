#!/bin/bash
# The benchmark on all cores of several nodes that see this folder and the environment below; see docs/cluster.md.
#SBATCH --job-name=rise
#SBATCH --nodes=16
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --mem=0
#SBATCH --time=12:00:00
#SBATCH --dependency=singleton
#SBATCH --open-mode=append

set -eo pipefail
source "$HOME/rise/.venv/bin/activate"
run=(python -m benchmarks.run --preset paper --out runs/paper)
spare=900 # seconds before the time limit, for tables and figures

RAY_AUTH_TOKEN=$(python -c 'import secrets; print(secrets.token_hex(32))')
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
ip=$(getent ahostsv4 "$(hostname)" | awk 'NR == 1 { print $1 }') # of this node, as the others see it
port=$((20000 + SLURM_JOB_ID % 10000))
others=$((SLURM_JOB_NUM_NODES - 1))

# Ray stores little where all nodes see the files: the memory is for jobs. Its start gives up after 30 s; where
# software comes from a busy shared disk, the second one is faster.
trap 'jobs -p | xargs -r kill || true; wait; ray stop --force' EXIT
for _ in 1 2 3; do
  ray start --head --node-ip-address="$ip" --port="$port" --include-dashboard=false \
    --num-cpus="$SLURM_CPUS_ON_NODE" --object-store-memory=1000000000 && break
  ray stop --force
done
if ((others)); then # they come when they can, also again
  srun --export=ALL --cpu-bind=none --nodes="$others" --ntasks="$others" --exclude="$SLURMD_NODENAME" bash -c '
    while :; do ray start --block --address="$0" --num-cpus="$SLURM_CPUS_ON_NODE" --object-store-memory=1000000000
    sleep 5; done' "$ip:$port" &
fi

end=$(squeue --noheader --jobs="$SLURM_JOB_ID" --format=%e)
left=$(($(date --date="$end" +%s) - $(date +%s) - spare))
"${run[@]}" --executor ray --ray-address "$ip:$port" --hours "$(awk "BEGIN { print $left / 3600 }")"
